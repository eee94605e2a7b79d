"""Recordings of tracker networks: the object in memory, and its readers and writers for all supported file formats."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltsim.recordings.exchange import (
        FORMATS as FORMATS,
        FileFormat as FileFormat,
        read as read,
        recognise_format as recognise_format,
        write as write,
    )
    from ltsim.recordings.hints import NO_HINTS as NO_HINTS, Hints as Hints
    from ltsim.recordings.recording import Recording as Recording
    from ltsim.recordings.setup import Setup as Setup

# Loaded when first used: who needs a recording in memory need not wait for every format.
_MODULES = {
    "exchange": ("FORMATS", "FileFormat", "read", "recognise_format", "write"),
    "hints": ("Hints", "NO_HINTS"),
    "recording": ("Recording",),
    "setup": ("Setup",),
}
_MODULE_BY_NAME = {name: module for module, names in _MODULES.items() for name in names}


def _load_public_name(name: str) -> Any:
    if name not in _MODULE_BY_NAME:
        raise AttributeError(f"module 'ltsim.recordings' has no attribute '{name}'")
    return getattr(import_module(f"ltsim.recordings.{_MODULE_BY_NAME[name]}"), name)


if not TYPE_CHECKING:
    __getattr__ = _load_public_name
