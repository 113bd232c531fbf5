"""Calibration and diagnosis: one engine that fits a car to simulations of a recording.

``problem`` poses it: windows of a recording are simulated, their errors whitened by the noise that is estimated along, and
nominal values and effects fitted under what is known of them. ``search`` asks which effects the data need: a score test over
the library, fits of the best, confirmation on parts that were left out. ``result`` is what comes of it: a diagnosis, or a
calibration, which is a diagnosis without candidates. Each imports from those before it alone.
"""
