"""Measurands: lengths, features and poses from adjusted points, with uncertainty (GUM, Monte Carlo) and conformity."""
