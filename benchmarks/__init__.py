"""Measurements of the whole package. Not installed."""
