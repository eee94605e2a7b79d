"""Acceptance tests of trackers, predicted or evaluated: tests of a standard, of a user, or by a network."""
