"""Simulate, calibrate, plan and diagnose laser-tracker networks.

The front door: `import ltsim as lt`, then `lt.read`, `lt.simulate`, `lt.calibrate`, `lt.diagnose` and the other names
of `__all__`, each loaded when it is first used. `lt.effects` is the room of the physical effects.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltsim import effects, errors
    from ltsim.api.campaigns import campaign
    from ltsim.api.catalogue import catalogue
    from ltsim.api.diagnosing import diagnose
    from ltsim.api.files import convert, read, write
    from ltsim.api.network import adjust, calibrate, correct, evaluate, history, verify
    from ltsim.api.pages import report, view
    from ltsim.api.planning import next_measurement, plan
    from ltsim.api.recovering import recover
    from ltsim.api.tasks import accept, check, compare, uncertainty
    from ltsim.api.workshop import scenario, simulate

    __version__: str

_HOME = {
    "read": "files",
    "write": "files",
    "convert": "files",
    "scenario": "workshop",
    "simulate": "workshop",
    "adjust": "network",
    "calibrate": "network",
    "correct": "network",
    "evaluate": "network",
    "verify": "network",
    "history": "network",
    "diagnose": "diagnosing",
    "campaign": "campaigns",
    "recover": "recovering",
    "plan": "planning",
    "next_measurement": "planning",
    "view": "pages",
    "report": "pages",
    "catalogue": "catalogue",
    "accept": "tasks",
    "check": "tasks",
    "compare": "tasks",
    "uncertainty": "tasks",
}
"""The module of `ltsim.api` in which each function is written."""

__all__ = [
    "accept",
    "adjust",
    "calibrate",
    "campaign",
    "catalogue",
    "check",
    "compare",
    "convert",
    "correct",
    "diagnose",
    "effects",
    "errors",
    "evaluate",
    "history",
    "next_measurement",
    "plan",
    "read",
    "recover",
    "report",
    "scenario",
    "simulate",
    "uncertainty",
    "verify",
    "view",
    "write",
]


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


class _Room(ModuleType):
    """A room that bears the name of a verb: calling it calls the verb, once Python has bound it to that name."""

    __doc__ = property(lambda self: self._verb.__doc__)  # help() shows the verb

    @property
    def _verb(self) -> Any:
        return _load(self.__name__.rpartition(".")[2])

    @property
    def __signature__(self) -> Any:
        from inspect import signature

        return signature(self._verb)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self._verb(*arguments, **options)


class _FrontDoor(ModuleType):
    """The package itself: makes rooms callable that would hide a verb."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _HOME and isinstance(value, ModuleType):
            value.__class__ = _Room
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _FrontDoor
