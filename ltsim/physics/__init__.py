"""Measurement model: physical effects (one module each), empirical laws, and the forward model of the readings."""
