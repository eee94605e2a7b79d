"""Acceptance tests of the standards, of one's own plan, or of one's own network: predicted and judged."""
