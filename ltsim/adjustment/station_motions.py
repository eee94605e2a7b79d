"""Motions of stations during their occupation, as effects that an adjustment estimates, and sentences on them.

A tripod that sinks or was touched distorts all readings from it. The package `identification` identifies the stations
that moved.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.reference_tests import length_sigma
from ltsim.core.arrays import Floats
from ltsim.core.notation import with_sigma
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.physics.effects.effect import LightPathStage
from ltsim.physics.effects.motions import StationMotionEffect
from ltsim.physics.effects.station_bump import StationBump
from ltsim.recordings.times import interval_text
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class UniformMotion(StationMotionEffect):
    """Motion of a station at a constant rate during its occupation.

    The parameters are the translation and rotation at the end of the occupation. The effect is not in the list of
    physical effects, because it has many possible causes. Consecutive pointings to one target get one time, because a
    change between them may be a motion of the target; only later repeats show a motion of the station.
    """

    name = "station-motion"
    """Name of the effect."""
    light_path_stage = LightPathStage.STATION
    """Part of the light path on which the effect acts."""
    covariates = ("time",)
    """Covariates on which the effect depends."""
    scope = "station"
    """Kind of object that the effect concerns: a station, which moves."""
    parameters = StationBump.parameters
    """Components of the translation and rotation at the end of the occupation, with the names of `StationBump`."""

    def motion(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 6, 6) of the motion at each of n pointings by the six components of the final motion."""
        share = with_mean_times_of_consecutive_pointings(sightings).elapsed_occupation_fraction
        return (self.pointing_indicator(sightings) * share)[:, None, None] * np.eye(6)


@dataclass(frozen=True)
class SuddenMotion(StationBump):
    """Sudden motion of a station, of any cause, between two of its pointings."""

    name = UniformMotion.name
    """Name of the effect, the same as for a motion at a constant rate."""


FittedMotion = UniformMotion | SuddenMotion
"""Motion of a station that an adjustment estimates: at a constant rate, or sudden."""


def with_mean_times_of_consecutive_pointings(sightings: Sightings) -> Sightings:
    """Sightings in which consecutive pointings from one station to one target have the mean of their times."""
    _, run = np.unique(np.stack([sightings.station, sightings.seating_numbers]), axis=1, return_inverse=True)
    return replace(sightings, time=(np.bincount(run, sightings.time) / np.bincount(run))[run])


def motions_with_sentences(adjustment: Adjustment) -> Iterator[tuple[FittedMotion, str]]:
    """Station motions that an adjustment estimates, each with a sentence for the user on its size."""
    first_column = 0
    for effect in adjustment.effects:
        columns = slice(first_column, first_column := first_column + len(effect.parameters))
        if isinstance(effect, FittedMotion):
            values, spread = adjustment.state.extra_parameters[columns], adjustment.effect_covariance[columns, columns]
            sizes = (("um", MICROMETRE, slice(0, 3)), ("urad", MICRORADIAN, slice(3, 6)))
            parts = " and ".join(
                _length_text(values[at] / factor, spread[at, at] / factor**2, unit) for unit, factor, at in sizes
            )
            moved = f"moves during its occupation, by {parts} in total"
            if isinstance(effect, SuddenMotion):
                sightings = adjustment.sightings
                order = sightings.measurement_order[
                    effect.pointing_indicator(sightings)[sightings.measurement_order] > 0
                ]
                at = int(np.searchsorted(sightings.time[order], effect.time))
                moved = f"moved {interval_text(adjustment.recording, *order[at - 1 : at + 1].tolist())}, by {parts}"
            yield (
                effect,
                f"station {', '.join(effect.stations)} {moved}: the motion is estimated, and its pointings stay in use",
            )


def _length_text(vector: Floats, covariance: Floats, unit: str) -> str:
    """Length of a vector (3,) with its standard deviation (from `covariance` (3, 3)) and unit, as text."""
    return with_sigma(float(np.linalg.norm(vector)), length_sigma(vector, covariance), unit)
