"""From images to volumes: the reconstruction loop. It knows of physics only `renderer.render`."""
