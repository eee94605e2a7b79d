"""Simulate, calibrate, plan and diagnose laser-tracker networks."""
