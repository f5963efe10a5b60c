"""The scheme the paper prints, for comparison."""
