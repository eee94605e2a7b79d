"""The forward model that simulator, calibrator, planner and diagnoser share."""
