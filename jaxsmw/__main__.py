"""The entry point of `python -m jaxsmw`, which runs the command line."""

from jaxsmw.cli import main

main()
