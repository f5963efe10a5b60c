"""What scatters and absorbs: coefficients and phase function."""
