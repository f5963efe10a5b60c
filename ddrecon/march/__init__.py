"""The integral along view rays. Read `integral.py` first: it is the definition."""
