"""Diagnosis: search for unmodelled causes of misfit in a recording, each with its place, size and probability."""
