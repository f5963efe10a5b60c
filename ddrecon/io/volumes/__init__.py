"""Volumes, by suffix through a table."""
