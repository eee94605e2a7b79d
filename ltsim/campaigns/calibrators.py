"""The calibrators of a campaign behind one door: a block of trials in, calibrated trials out."""

from __future__ import annotations

from typing import Protocol

from ltsim.arrays import Ints
from ltsim.campaigns.cell import fitted_construction, fitted_effects
from ltsim.campaigns.distance import BatchDistance
from ltsim.campaigns.engine import Calibrated, Engine
from ltsim.campaigns.equation_9 import BatchEquation9
from ltsim.campaigns.single import Single
from ltsim.campaigns.spec import Method
from ltsim.campaigns.truth import Block, Truth
from ltsim.effects.effect import Effect
from ltsim.errors import SetupError
from ltsim.model.construction import Construction


class Calibrator(Protocol):
    """What a campaign needs of a method."""

    @property
    def construction(self) -> Construction:
        """Whose parameters are estimated."""
        ...

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Further effects that are estimated."""
        ...

    def calibrate(self, block: Block, wanted: Ints) -> Calibrated:
        """Calibrate a block; trials that are not wanted may be left out (NaN)."""
        ...

    def difference(self, block: Block, trial: int, found: Calibrated) -> float:
        """Largest difference [sigma] of a trial from the calibrator that users have; NaN where that is itself."""
        ...


def calibrator_of(method: Method, truth: Truth) -> Calibrator:
    """The calibrator that a campaign file asks for."""
    if method.method != "network" and not truth.recorded.all():
        raise SetupError(f"methods.{method.title}: {method.method} compares points, which ranges or angles alone lack")
    construction, effects = fitted_construction(method), fitted_effects(method)
    if method.solver == "single":
        return Single(truth, construction, effects, method.method, applied=method.applied)
    if method.method.startswith("equation-9"):
        return BatchEquation9(truth, construction, method.method.replace("equation-9", "distance"))
    if method.method != "network":
        return BatchDistance(truth, construction, method.method)
    return Engine(truth, construction, effects)
