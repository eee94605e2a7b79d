"""Geometry of points: rotations, polar coordinates, closed-form alignment, kinematic chains."""
