"""Calibration of a tracker: instrument parameters from a recording, undetermined combinations, corrected readings."""
