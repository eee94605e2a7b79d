"""Kinematic chains: how a tracker turns readings into a point. One construction a file."""
