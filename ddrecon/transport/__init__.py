"""Transport rounds: sweeps that take diffusion towards transport."""
