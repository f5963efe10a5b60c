"""Light that has not been scattered yet: beams, skies, and their moments."""
