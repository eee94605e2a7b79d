"""The methods of a campaign file as calibrators: a block of trials in, calibrated trials out."""

from __future__ import annotations

from ltsim.campaigns.distance import BatchDistance
from ltsim.campaigns.engine import Calibrator, Engine, Single
from ltsim.campaigns.spec import Method
from ltsim.campaigns.truth import Truth
from ltsim.effects.effect import Effect
from ltsim.errors import ModelError, SetupError
from ltsim.model.construction import Construction, construction, dh
from ltsim.simulation.physics import effect_from


def fitted_construction(method: Method) -> Construction:
    """The construction whose parameters a method estimates."""
    if method.construction == "dh":
        return dh(method.harmonics, method.degree)
    return construction(method.construction)


def fitted_effects(method: Method) -> tuple[Effect, ...]:
    """The further effects that a method estimates.

    Raises
    ------
    SetupError
        Naming the method's entry and what would be right.
    """
    found = []
    for number, entry in enumerate(method.effects):
        places = {"stations": entry.stations, "targets": entry.targets}
        try:
            found.append(effect_from(entry.name, places, entry.shape))
        except (ModelError, ValueError, TypeError, KeyError) as problem:
            raise SetupError(f"methods.{method.title}.effects.{number + 1}: {problem}") from None
    return tuple(found)


def calibrator_of(method: Method, truth: Truth) -> Calibrator:
    """The calibrator that a campaign file asks for."""
    if method.method != "network" and not truth.recorded.all():
        raise SetupError(f"methods.{method.title}: {method.method} compares points, which ranges or angles alone lack")
    built, effects = fitted_construction(method), fitted_effects(method)
    if method.solver == "single":
        return Single(truth, built, effects, method.method, applied=method.applied)
    if method.method != "network":
        return BatchDistance(truth, built, method.method)
    return Engine(truth, built, effects)
