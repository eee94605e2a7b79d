"""Benchmarks: ``python -m benchmarks.calibrations``."""
