"""Measurands: tasks on adjusted points, their uncertainty by the GUM and by Monte Carlo, and conformity decisions."""
