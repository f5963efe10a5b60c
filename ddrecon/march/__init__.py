"""The integral along view rays. Read `plain.py` first: it is all of it, in plain sums."""
