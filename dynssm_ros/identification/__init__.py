"""One engine for calibration and diagnosis: prediction errors, noise, least squares, candidates, selection."""
