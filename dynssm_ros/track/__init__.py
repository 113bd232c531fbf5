"""Geometry of roads: lines, tracks, racing line, speed profile, position on the lap. Real and simulated cars alike."""
