"""Forward model that simulator, calibrator, planner and diagnosis share."""
