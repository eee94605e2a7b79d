"""Diagnosis: from a recording to the physics that was left out."""
