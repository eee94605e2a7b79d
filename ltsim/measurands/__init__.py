"""Measurands: results computed from adjusted points, their uncertainty (GUM and Monte Carlo), conformity decisions."""
