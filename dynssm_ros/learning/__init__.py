"""The learned models, their losses, training and export; and calibration. The only room that imports torch."""
