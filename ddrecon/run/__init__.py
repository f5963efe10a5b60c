"""What commands leave on disk."""
