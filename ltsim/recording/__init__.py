"""Recordings of tracker networks: in memory, in the native folder and in the formats that people have."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltsim.recording.conventions import NO_HINTS as NO_HINTS, Hints as Hints
    from ltsim.recording.exchange import (
        FORMATS as FORMATS,
        Format as Format,
        read as read,
        recognised as recognised,
        write as write,
    )
    from ltsim.recording.recording import Recording as Recording
    from ltsim.recording.setup import Setup as Setup

# Loaded when first used: who needs a recording in memory need not wait for every format.
_ROOMS = {
    "conventions": ("Hints", "NO_HINTS"),
    "exchange": ("FORMATS", "Format", "read", "recognised", "write"),
    "recording": ("Recording",),
    "setup": ("Setup",),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}


def _load(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ltsim.recording' has no attribute '{name}'")
    return getattr(import_module(f"ltsim.recording.{_HOME[name]}"), name)


if not TYPE_CHECKING:
    __getattr__ = _load
