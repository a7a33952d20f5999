"""Calibration: from observations to parameters, their honest errors and the verdict."""
