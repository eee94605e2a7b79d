"""Forward model (network and instrument to readings) that simulator, calibrator, planner and diagnosis use."""
