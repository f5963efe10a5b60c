"""Checks of the program against itself."""
