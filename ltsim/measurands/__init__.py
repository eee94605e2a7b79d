"""Measurands (lengths, features, poses) from adjusted points, with uncertainty (GUM, Monte Carlo) and conformity."""
