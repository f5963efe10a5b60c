"""The integral along view rays."""
