"""`python -m ddrecon` is the command line, where the program `ddrecon` is not on the path."""

from ddrecon.cli import main

main(prog_name="ddrecon")
