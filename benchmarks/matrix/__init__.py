"""Cars, tracks, hidden changes, noise and models in all combinations: predicted (scores) and driven (races)."""
