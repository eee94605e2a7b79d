"""Acceptance tests of trackers, predicted or evaluated: tests of a standard, of the user, or in an adjusted network."""
