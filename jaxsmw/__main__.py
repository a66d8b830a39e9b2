"""`python -m jaxsmw`."""

from jaxsmw.cli import main

main()
