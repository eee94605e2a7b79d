"""Simulation, calibration, planning and diagnosis of laser-tracker networks: ``import ltsim as lt``.

The public names are in `__all__`, such as `lt.read`, `lt.simulate`, `lt.calibrate` and `lt.diagnose`. Each name is
loaded from its package when it is first used. `lt.effects` is the package of the physical effects.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ltsim.core.plotting import register_plotting_loader

if TYPE_CHECKING:
    from ltsim.acceptance.verbs import accept as accept
    from ltsim.adjustment.evaluation.bench import bench as bench
    from ltsim.adjustment.fieldcheck.check import check as check
    from ltsim.api import convert as convert, read as read, write as write
    from ltsim.calibration.correct import correct as correct
    from ltsim.calibration.network import adjust as adjust
    from ltsim.calibration.verbs import (
        calibrate as calibrate,
        evaluate as evaluate,
        history as history,
        verify as verify,
    )
    from ltsim.campaigns.calibration_comparison import compare_calibrations as compare_calibrations
    from ltsim.campaigns.injection import inject as inject, injection_curve as injection_curve
    from ltsim.campaigns.recovery import recover as recover
    from ltsim.campaigns.recovery_checks import recovery_checks as recovery_checks
    from ltsim.campaigns.verbs import campaign as campaign
    from ltsim.core import errors as errors
    from ltsim.diagnosis.verbs import diagnose as diagnose
    from ltsim.measurands.verbs import compare as compare, uncertainty as uncertainty
    from ltsim.physics import effects as effects
    from ltsim.physics.effects.verbs import Effect as Effect, add_effect as add_effect, catalogue as catalogue
    from ltsim.planning.verbs import (
        next_measurement as next_measurement,
        plan as plan,
        station_alternatives as station_alternatives,
    )
    from ltsim.recordings import Hints as Hints
    from ltsim.reports.verbs import report as report, view as view
    from ltsim.simulation.verbs import scenario as scenario, simulate as simulate

    __version__: str

_PUBLIC_NAMES_BY_MODULE = {
    "api": ("read", "write", "convert"),
    "simulation.verbs": ("scenario", "simulate"),
    "calibration.correct": ("correct",),
    "calibration.network": ("adjust",),
    "calibration.verbs": ("calibrate", "evaluate", "verify", "history"),
    "diagnosis.verbs": ("diagnose",),
    "campaigns.verbs": ("campaign",),
    "campaigns.calibration_comparison": ("compare_calibrations",),
    "campaigns.recovery": ("recover",),
    "campaigns.recovery_checks": ("recovery_checks",),
    "campaigns.injection": ("inject", "injection_curve"),
    "planning.verbs": ("plan", "next_measurement", "station_alternatives"),
    "recordings": ("Hints",),
    "reports.verbs": ("view", "report"),
    "physics.effects.verbs": ("Effect", "add_effect", "catalogue"),
    "measurands.verbs": ("compare", "uncertainty"),
    "acceptance.verbs": ("accept",),
    "adjustment.evaluation.bench": ("bench",),
    "adjustment.fieldcheck.check": ("check",),
}
"""Names of the public functions and classes, by the module in `ltsim` that defines them."""
_MODULE_BY_PUBLIC_NAME = {name: module for module, names in _PUBLIC_NAMES_BY_MODULE.items() for name in names}
"""Module in `ltsim` that defines a public function or class, by its name."""

_PUBLIC_MODULES = {"effects": "ltsim.physics.effects", "errors": "ltsim.core.errors"}
"""Full paths of the public modules, by their public names."""

__all__ = sorted([*_MODULE_BY_PUBLIC_NAME, "effects", "errors"])


register_plotting_loader(lambda module: import_module(f"ltsim.reports.{module}"))


def _import_public_name(name: str) -> Any:
    """Public function, class or module with this name, imported at its first use; AttributeError for other names."""
    if name in _MODULE_BY_PUBLIC_NAME:
        return getattr(import_module(f"ltsim.{_MODULE_BY_PUBLIC_NAME[name]}"), name)
    if name in _PUBLIC_MODULES:
        return import_module(_PUBLIC_MODULES[name])
    if name == "__version__":
        from importlib.metadata import version

        return version("ltsim")
    raise AttributeError(f"module 'ltsim' has no attribute '{name}'")


if not TYPE_CHECKING:  # a type checker would take any name for one of this module
    __getattr__ = _import_public_name


def __dir__() -> list[str]:
    """Public names of the package, for completion in an editor."""
    return [*__all__, "__version__"]
