"""Recordings of tracker networks: in memory, in the native folder and in the formats that people have."""

from ltsim.recording.conventions import NO_HINTS, Hints
from ltsim.recording.exchange import FORMATS, Format, read, recognised, write
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Setup

__all__ = ["FORMATS", "NO_HINTS", "Format", "Hints", "Recording", "Setup", "read", "recognised", "write"]
