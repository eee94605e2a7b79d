"""Nuisance errors with a prior: heights of heads, errors that several readings share, refraction near the ground.

Each is estimated together with the network.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import EARTH, MILLIMETRE
from ltsim.physics.effects.effect import on_readings
from ltsim.physics.effects.signature import Parameter, Signature, by_displacement
from ltsim.recordings.recording import (
    ENDINGS,
    OBSERVABLES,
    OCCUPATION_COLUMNS,
    SHARED_COLUMN,
    SIGMA_UNITS,
    Recording,
)
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class HeadHeights(Signature):
    """Heights of instrument and reflector over their marks, less the declared ones, one for each of q occupations."""

    sigma: float
    """[m] Standard deviation of each error."""
    lift: Floats
    """(n, q): 1 for pointings to an occupation, -1 for those from it."""
    up: Floats
    """Direction of plumb, (n, 3)."""

    @property
    def name(self) -> str:
        """Name of the law."""
        return "head-heights"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Centring errors, one per occupation; `prior_sigma` is the declared standard deviation."""
        return (Parameter("head-height", "mm", "height of a head", self.sigma),) * self.lift.shape[1]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, q) of the raw readings by each height."""
        return by_displacement(sightings, self.up[:, :, None] * self.lift[:, None])


def head_heights(recording: Recording, vertical: Floats) -> tuple[HeadHeights, ...]:
    """The heights of a recording that states how well they are known; `vertical` (S, 3) at its stations.

    An occupation is what a cell of the columns `instrument_setup` and `target_setup` names; an empty one has none.
    """
    sigma = recording.setup.heads_sigma_mm
    if sigma is None:
        return ()
    occupations = [recording.labels.get(column, ("",) * len(recording)) for column in OCCUPATION_COLUMNS]
    marks = [recording.targets[t] for t in recording.target]
    ends = [[("", occupation) for occupation in occupations[0]], list(zip(marks, occupations[1], strict=True))]
    number_of = {key: i for i, key in enumerate(dict.fromkeys(key for end in ends for key in end if key[1]))}
    if not number_of:
        return ()
    rows = np.eye(len(number_of) + 1, len(number_of))
    at, to = (rows[[number_of.get(key, len(number_of)) for key in end]] for end in ends)
    return (HeadHeights(sigma * MILLIMETRE, to - at, vertical[recording.station]),)


@dataclass(frozen=True)
class SharedErrors(Signature):
    """q independent errors, in standard deviations, each of which reaches several readings.

    Readings with a noise D of their own and these errors F have the covariance D^2 + F F'; to estimate the errors
    beside the network is to adjust with that covariance.
    """

    reach: Floats
    """Change of each reading by one standard deviation, (n, 3, q) [m, rad]."""
    flat: Bools
    """Distances reduced to the horizontal, (n,)."""

    @property
    def name(self) -> str:
        """Name of the law."""
        return "shared-errors"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Errors, one per unknown, each with a prior of one standard deviation."""
        return (Parameter("shared-error", "", "error that readings share", 1.0),) * self.reach.shape[2]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, q) of the raw readings by each error.

        A horizontal distance h = r cos(e) is reduced from raw readings, but its error is stated by itself: r changes by
        what it asks for, and by what makes up for the error of e.
        """
        reach, (range_, _, elevation) = self.reach.copy(), sightings.read[self.flat].T[:, :, None]
        cosine = np.cos(elevation)
        change = np.sign(cosine) * reach[self.flat, 0] + range_ * np.sin(elevation) * reach[self.flat, 2]
        reach[self.flat, 0] = change / cosine
        return reach


def shared_errors(recording: Recording) -> tuple[SharedErrors, ...]:
    """The errors that the columns `shared_NAME_...` of a recording state; an empty cell is none."""
    columns = {name: parts for name in recording.covariates if (parts := SHARED_COLUMN.fullmatch(name))}
    names = list(dict.fromkeys(parts[1] for parts in columns.values()))
    if not names:
        return ()
    reach = np.zeros((len(recording), len(OBSERVABLES), len(names)))
    for name, parts in columns.items():
        k = ENDINGS.index(parts[2])
        reach[:, k, names.index(parts[1])] = np.nan_to_num(recording.covariates[name]) * SIGMA_UNITS[k]
    return (SharedErrors(reach, recording.is_horizontal),)


@dataclass(frozen=True)
class Refraction(Signature):
    """Refraction near the ground with a prior: the coefficient k is the radius of the earth over that of the ray.

    A sight of length d leaves its chord by the angle k d / 2 R and lifts the image of the target.
    """

    mean: float
    sigma: float
    """Expected coefficient and its standard deviation."""

    @property
    def name(self) -> str:
        """Name of the law."""
        return "refraction"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficient of refraction less its mean, with its standard deviation."""
        return (Parameter("refraction", "", "coefficient of refraction", self.sigma),)

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of the coefficient."""
        _, across, up = sightings.unit_vectors
        bend = -sightings.range_ / (2.0 * EARTH)  # corrections, hence the sign
        azimuth = bend * across[:, 2] / np.cos(sightings.elevation)
        return on_readings(sightings, azimuth=azimuth, elevation=bend * up[:, 2])[:, :, None]

    def shift(self, sightings: Sightings, values: Floats) -> Floats:
        """Change (n, 3) of the raw readings by a coefficient that differs from its mean by values (1,)."""
        return self.design(sightings) @ (self.mean + values)


def refraction_of(recording: Recording) -> tuple[Refraction, ...]:
    """Refraction where the set-up gives its coefficient with a standard deviation."""
    given = recording.setup.refraction
    return () if given is None else (Refraction(*given),)
