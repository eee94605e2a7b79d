"""Benchmarks of ltsim; run one by ``python -m benchmarks.calibrations``."""
