"""Empirical laws of unknown physics: a response depends on a regressor at a place. This package contains no search."""
