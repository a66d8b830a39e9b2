"""`python -m jaxsmw`."""

from jaxsmw.cli.main import main

main()
