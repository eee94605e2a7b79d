"""Recordings of tracker networks: in memory, in the native folder and in the formats that people have."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltsim.recording.conventions import NO_HINTS, Hints
    from ltsim.recording.exchange import FORMATS, Format, read, recognised, write
    from ltsim.recording.recording import Recording
    from ltsim.recording.setup import Setup

# Loaded when first used: who needs a recording in memory need not wait for every format.
_HOME = {
    "Hints": "conventions",
    "NO_HINTS": "conventions",
    "FORMATS": "exchange",
    "Format": "exchange",
    "read": "exchange",
    "recognised": "exchange",
    "write": "exchange",
    "Recording": "recording",
    "Setup": "setup",
}

__all__ = ["FORMATS", "NO_HINTS", "Format", "Hints", "Recording", "Setup", "read", "recognised", "write"]


def _load(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ltsim.recording' has no attribute '{name}'")
    return getattr(import_module(f"ltsim.recording.{_HOME[name]}"), name)


if not TYPE_CHECKING:
    __getattr__ = _load
