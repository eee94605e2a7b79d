"""Empirical laws, in which an observable or constant depends on a regressor without a known physical cause."""
