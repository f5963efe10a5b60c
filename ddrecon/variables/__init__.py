"""The numbers of a scene, by name."""
