"""Diagnosis: unmodelled causes in a recording, with place, size and probability."""
