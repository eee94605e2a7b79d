"""Geometry of the hall: floor, obstacles, lines of sight, and visibility between instruments and targets."""
