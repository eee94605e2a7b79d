"""Kinematic chains that turn the readings of a tracker into a point, one construction per file."""
