"""Modules that all packages use: errors, units, random streams, notation, results, file storage, limits, processes."""
