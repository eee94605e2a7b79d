"""Concealed recordings: drawn, sealed, diagnosed by another process, unsealed and scored."""
