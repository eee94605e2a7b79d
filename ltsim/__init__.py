"""Simulate, calibrate, plan and diagnose laser-tracker networks.

The front door: `import ltsim as lt`, then `lt.read`, `lt.simulate`, `lt.calibrate`, `lt.diagnose` and the other names
of `__all__`, each loaded when it is first used. `lt.effects` is the room of the physical effects.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltsim import effects as effects, errors as errors
    from ltsim.api.campaigns import campaign as campaign
    from ltsim.api.catalogue import add_effect as add_effect, catalogue as catalogue
    from ltsim.api.diagnosing import diagnose as diagnose
    from ltsim.api.files import convert as convert, read as read, write as write
    from ltsim.api.network import (
        adjust as adjust,
        calibrate as calibrate,
        correct as correct,
        evaluate as evaluate,
        history as history,
        verify as verify,
    )
    from ltsim.api.pages import report as report, view as view
    from ltsim.api.planning import (
        next_measurement as next_measurement,
        plan as plan,
        without_station as without_station,
    )
    from ltsim.api.recovering import recover as recover, recovery_checks as recovery_checks
    from ltsim.api.tasks import (
        accept as accept,
        bench as bench,
        check as check,
        compare as compare,
        uncertainty as uncertainty,
    )
    from ltsim.api.workshop import scenario as scenario, simulate as simulate

    __version__: str

_ROOMS = {
    "files": ("read", "write", "convert"),
    "workshop": ("scenario", "simulate"),
    "network": ("adjust", "calibrate", "correct", "evaluate", "verify", "history"),
    "diagnosing": ("diagnose",),
    "campaigns": ("campaign",),
    "recovering": ("recover", "recovery_checks"),
    "planning": ("plan", "next_measurement", "without_station"),
    "pages": ("view", "report"),
    "catalogue": ("catalogue", "add_effect"),
    "tasks": ("accept", "bench", "check", "compare", "uncertainty"),
}
"""The functions that each module of `ltsim.api` holds."""
_HOME = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = sorted([*_HOME, "effects", "errors"])


def _load(name: str) -> Any:
    """Load a name of the front door when it is first asked for."""
    if name in _HOME:
        return getattr(import_module(f"ltsim.api.{_HOME[name]}"), name)
    if name in ("effects", "errors"):
        return import_module(f"ltsim.{name}")
    if name == "__version__":
        from importlib.metadata import version

        return version("ltsim")
    raise AttributeError(f"module 'ltsim' has no attribute '{name}'")


if not TYPE_CHECKING:  # a type checker would take any name for one of this module
    __getattr__ = _load


def __dir__() -> list[str]:
    """The names of the front door, for completion."""
    return [*__all__, "__version__"]
