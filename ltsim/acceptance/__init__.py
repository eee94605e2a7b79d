"""Acceptance tests of trackers: tests of the standards, of a user's plan, or by a user's network.

Predicted or evaluated.
"""
