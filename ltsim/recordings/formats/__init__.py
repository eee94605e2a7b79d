"""Formats that people have: one file a format."""
