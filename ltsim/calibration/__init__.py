"""Calibration: instrument parameters from a recording, undetermined combinations, and the corrected recording."""
