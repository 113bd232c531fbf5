"""What comes of a fit: the calibrated or diagnosed car, its improvement on held-out laps, and what is left."""
