"""Measurands: results computed from adjusted points, with their uncertainty (GUM, Monte Carlo) and conformity."""
