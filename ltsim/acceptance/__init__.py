"""Acceptance tests of a tracker against its manufacturer's limits: prediction, and evaluation of measured errors."""
