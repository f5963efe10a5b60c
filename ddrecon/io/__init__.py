"""Files of data: images and volumes, each format behind a table by suffix. Nothing here knows of
scenes or of physics.
"""
