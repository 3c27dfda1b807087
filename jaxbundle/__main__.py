"""`python -m jaxbundle` is the command line."""

from jaxbundle.cli import main

main()
