"""Images, by suffix through a table."""
