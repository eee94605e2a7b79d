"""Geometry of the hall: floor, obstacles, lines of sight, and visibility of targets from instruments."""
