"""Diagnosis: from a recording to the physics that was left out."""

from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.schema import Finding

__all__ = ["Diagnosis", "Finding", "diagnose"]
