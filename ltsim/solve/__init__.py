"""Least squares on matrices, independent of trackers: solvers, elimination, projections."""
