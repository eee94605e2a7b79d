"""Least squares on matrices. This package knows no tracker."""
