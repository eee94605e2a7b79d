"""The measurement model: physical effects, one small file each, empirical laws, and what predicts a reading."""
