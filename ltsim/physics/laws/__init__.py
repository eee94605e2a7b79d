"""Empirical laws: an observable or an instrument constant depends on a regressor, without a known physical cause."""
