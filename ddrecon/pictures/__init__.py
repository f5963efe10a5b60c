"""What pictures are: how they are displayed, how they err, on what scale they are compared."""
