"""Campaigns: many trials over a grid of settings, run fast, kept safely, summarised by queries."""
