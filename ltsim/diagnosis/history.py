"""Constants of an instrument against its earlier calibrations: which have changed by more than they usually do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import ParameterPrior, prior_sigmas
from ltsim.calibration.known import Known
from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.diagnosis.instruments import Change, Contradiction, Expected, compared
from ltsim.physics.effects.effect import Parameter
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import Recording

TOLD = 1e-3
"""Information on a constant, in guarantees, that earlier calibrations have at least."""
SCATTERS = np.geomspace(0.05, 1e4, 80)
"""True variance of a constant over that which a few calibrations show."""
ALIKE = 4
"""Degrees of freedom that the other constants' spreads are worth: most lie within a factor of two of each other."""


@dataclass(frozen=True)
class HistoryExpectation:
    """Expectation of the constants of a recording's instruments by earlier calibrations."""

    known: Known
    expected: ParameterPrior
    """Mean and covariance, the day-to-day spread in it."""
    guarantee: Floats
    """(I, p) [SI], the maker's: the unit of all that is computed here."""

    @classmethod
    def of(cls, known: Known, recording: Recording, construction: Construction) -> HistoryExpectation:
        """Raise RecordError where the earlier calibrations are of other instruments or another construction."""
        names = recording.instruments
        if len(known.instruments) < min(len(names), 2):
            raise RecordError(
                f"the earlier calibrations are of one instrument, the recording is of {', '.join(names)}; expected "
                "those of all of them"
            )
        stated = ParameterPrior.independent(prior_sigmas(recording, construction))
        return cls(known, known.over(stated, construction, names), stated.sigma)

    def contradictions(self, adjustment: Adjustment, least: float) -> list[Contradiction]:
        """Constants that have changed, each with more than `least` of log evidence, the most certain first."""
        parameters, unit = adjustment.construction.parameters, self.guarantee
        at = [k for k, p in enumerate(parameters) if p.name in self.known.parameters]
        names = [parameters[k].name for k in at]
        covariance = [own / np.outer(u, u) for own, u in zip(self.expected.covariance, unit, strict=True)]
        changes: list[Change] = []
        for i, own in enumerate(covariance):
            spreads = zip(*self._spreads(own[np.ix_(at, at)], unit[i, at], names), strict=True)
            changes += [Change((i,), k, self._words(parameters[k]), *s) for k, s in zip(at, spreads, strict=True)]
        mean = (self.expected.mean / unit).ravel()
        return compared(adjustment, Expected(mean, linalg.block_diag(*covariance), tuple(changes)), least)

    def _spreads(self, variance: Floats, unit: Floats, names: list[str]) -> tuple[Floats, Floats]:
        """Variances (k, s) that constants may have beside the expected ones (k, k), and the logs of their weights.

        What a few calibrations scatter beyond their own noise is the spread, uncertain itself: they tell the variance
        of a constant as chi-square, one degree less than there are of them, and the spreads of the other constants, in
        guarantees, are worth some degrees more (Smyth, Statistical Applications in Genetics 3 (2004) 3). No constant
        is taken to wander by more than its maker guarantees.
        """
        count = self.known.count
        if count == 1:
            return np.zeros((len(unit), 1)), np.zeros((len(unit), 1))
        spread = self.known.spread[[self.known.parameters.index(name) for name in names]] ** 2 / unit**2
        told = np.diag(np.linalg.inv(variance - np.diag(spread))) - 1.0  # of the mean, without the maker's guarantee
        scatter = count / np.maximum(told, TOLD)
        usual = scatter + np.median(spread) - spread
        wider = np.minimum(np.outer(scatter, SCATTERS - 1.0), np.maximum(1.0 - spread, 0.0)[:, None])
        shown = (count - 1 + ALIKE * usual / scatter)[:, None]
        weights = -0.5 * (count - 1 + ALIKE) * np.log(SCATTERS) - 0.5 * shown / SCATTERS
        return np.maximum(wider * (1.0 + 1.0 / count), -spread[:, None]), weights

    def _words(self, parameter: Parameter) -> str:
        """Name of the reference that a constant is compared with."""
        if self.known.count == 1:
            return "its calibration"
        spread = self.known.spread[self.known.parameters.index(parameter.name)] / parameter.factor
        return f"its history ({self.known.count} calibrations, spread {spread:.2g} {parameter.unit})"
