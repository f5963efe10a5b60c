"""From images to volumes: the reconstruction loop. It sees light in pictures alone."""
