"""Empirical laws: a reading or an instrument constant is a function of a regressor, without a known physical cause."""
