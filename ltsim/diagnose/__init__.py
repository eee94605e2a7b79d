"""Diagnosis: from a recording to the physics that was left out."""

from ltsim.diagnose.diagnose import diagnose
from ltsim.diagnose.diagnosis import Diagnosis
from ltsim.diagnose.schema import Finding

__all__ = ["Diagnosis", "Finding", "diagnose"]
