"""The numbers of a scene by name: `values` reads and replaces them, `kinds` is what they are."""
