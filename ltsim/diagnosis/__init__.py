"""Diagnosis: search for unmodelled causes in a recording, with the place, size and probability of each."""
