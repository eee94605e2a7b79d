"""Least squares on matrices. This room has never heard of a tracker."""
