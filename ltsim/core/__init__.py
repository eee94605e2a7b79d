"""Foundations of every package: errors, units, randomness, text, results, storage, limits, processes."""
