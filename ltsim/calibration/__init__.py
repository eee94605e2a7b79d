"""Calibration of a tracker: its parameters from a recording, undetermined combinations, and corrected readings."""
