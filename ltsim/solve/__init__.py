"""Least-squares solvers for general matrices, independent of trackers: elimination, iteration, projection."""
