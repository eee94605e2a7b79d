"""Calibration: instrument parameters from a recording, what could not be determined, and the corrected recording."""
