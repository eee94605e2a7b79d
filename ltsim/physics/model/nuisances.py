"""Nuisance parameters with a prior: errors of heights, centring errors, errors common to several readings, refraction.

An adjustment estimates them together with the network.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import EARTH_RADIUS, MILLIMETRE
from ltsim.physics.effects.effect import design_from_front_face_corrections
from ltsim.physics.effects.linear_effect import LinearEffect, Parameter, design_from_displacements
from ltsim.physics.effects.motions import TargetDisplacement
from ltsim.recordings.occupations import target_occupations
from ltsim.recordings.recording import (
    OBSERVABLE_NAMES_WITH_UNIT,
    OBSERVABLES,
    OCCUPATION_COLUMNS,
    SHARED_ERROR_COLUMN_PATTERN,
    SIGMA_UNITS,
    Recording,
)
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class HeightErrors(LinearEffect):
    """Errors of the heights of instruments and reflectors above their ground marks, one for each of q occupations.

    An occupation is the time during which an instrument or reflector stands over a ground mark.
    """

    height_sigma: float
    """Standard deviation [m] of each height error."""
    occupation_coefficients: Floats
    """Coefficients (n, q) of the height errors of q occupations (times over a ground mark) in n pointings: 1 for the
    occupation of the reflector, -1 for the occupation of the instrument, otherwise 0."""
    plumb_directions: Floats
    """Unit vectors (n, 3) upward along the plumb line at the station of each of n pointings."""

    @property
    def name(self) -> str:
        """Name of the height errors in lists of nuisance errors."""
        return "head-heights"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Height errors, one per occupation of a ground mark, with the declared standard deviation as prior."""
        return (
            Parameter("head-height", "mm", "height error of an instrument or reflector", self.height_sigma),
        ) * self.occupation_coefficients.shape[1]

    def design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, q) of the raw readings of n pointings with respect to the q height errors."""
        return design_from_displacements(
            sightings, self.plumb_directions[:, :, None] * self.occupation_coefficients[:, None]
        )


def height_errors(recording: Recording, plumb_directions: Floats) -> tuple[HeightErrors, ...]:
    """Height errors of a recording in a tuple; empty if its set-up declares no standard deviation of heights.

    The columns `instrument_setup` and `target_setup` of the recording name the occupations of each pointing. A pointing
    with an empty cell there has no height error. `plumb_directions` (S, 3) are upward unit vectors at the S stations.
    """
    sigma = recording.setup.height_above_mark_sigma_mm
    if sigma is None:
        return ()
    occupations = [recording.labels.get(column, ("",) * len(recording)) for column in OCCUPATION_COLUMNS]
    marks = [recording.targets[t] for t in recording.target]
    ends = [[("", occupation) for occupation in occupations[0]], list(zip(marks, occupations[1], strict=True))]
    index_of_occupation = {key: i for i, key in enumerate(dict.fromkeys(key for end in ends for key in end if key[1]))}
    if not index_of_occupation:
        return ()
    unit_rows = np.eye(len(index_of_occupation) + 1, len(index_of_occupation))
    at, to = (unit_rows[[index_of_occupation.get(key, len(index_of_occupation)) for key in end]] for end in ends)
    return (HeightErrors(sigma * MILLIMETRE, to - at, plumb_directions[recording.station]),)


@dataclass(frozen=True)
class CentringErrors(TargetDisplacement):
    """Centring errors: displacements of reflectors from their targets, three components per occupation of a target.

    All pointings of an occupation have the same displacement.
    """

    displacement_sigma: float
    """Standard deviation [m] of each component of a displacement."""
    occupation_indices: Ints
    """Index (n,) of the occupation (placement of a reflector) of each of n pointings; -1 for a pointing without
    displacement."""

    @property
    def name(self) -> str:
        """Name of the centring errors in lists of nuisance errors."""
        return "centring-errors"

    @property
    def n_occupations(self) -> int:
        """Number of occupations of targets (placements of reflectors)."""
        return int(self.occupation_indices.max(initial=-1)) + 1

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The q components of all displacements along the network axes, with the prior sigma `displacement_sigma`."""
        return (
            Parameter("centring-error", "mm", "centring error of a reflector along an axis", self.displacement_sigma),
        ) * (3 * self.n_occupations)

    def displacement(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, q) of the reflector's displacement in n pointings by q components of displacements."""
        displacements = np.zeros((len(sightings), 3, self.n_occupations, 3))
        occupied_rows = np.flatnonzero(self.occupation_indices >= 0)
        displacements[occupied_rows, :, self.occupation_indices[occupied_rows]] = np.eye(3)
        return displacements.reshape(len(sightings), 3, -1)


def centring_errors(recording: Recording) -> tuple[CentringErrors, ...]:
    """Centring errors that the set-up of a recording declares, one entry per declaration."""
    return tuple(
        CentringErrors(centring.sigma_mm * MILLIMETRE, target_occupations(recording, centring))
        for centring in recording.setup.centring
    )


@dataclass(frozen=True)
class SharedErrors(LinearEffect):
    """Errors common to several readings: q independent errors in units of their standard deviations.

    Let D be the diagonal matrix of the standard deviations of the independent noise. Let F be the changes of the
    readings by one standard deviation of each common error. The readings then have the covariance D^2 + F F'. To
    estimate the errors together with the network is equivalent to an adjustment with this covariance.
    """

    reading_changes_per_sigma: Floats
    """Change (n, 3, q) [m, rad, rad] of the readings of n pointings by one standard deviation of each error."""
    is_horizontal_distance: Bools
    """Mask (n,) of the pointings whose distance is reduced to the horizontal."""

    @property
    def name(self) -> str:
        """Name of the shared errors in lists of nuisance errors."""
        return "shared-errors"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The q errors as parameters in units of their standard deviations, with a prior standard deviation of 1."""
        return (
            Parameter("shared-error", "", "error that readings share", 1.0),
        ) * self.reading_changes_per_sigma.shape[2]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, q) of the raw readings of n pointings by one standard deviation of each of q errors.

        The error of a horizontal distance h = r cos(e) is declared for h, but the result is for the raw range r and
        elevation e. The change of r is therefore such that h, with the changed e, changes by the declared error.
        """
        range_changes, (range_, _, elevation) = (
            self.reading_changes_per_sigma.copy(),
            sightings.instrument_readings[self.is_horizontal_distance].T[:, :, None],
        )
        cosine = np.cos(elevation)
        change = (
            np.sign(cosine) * range_changes[self.is_horizontal_distance, 0]
            + range_ * np.sin(elevation) * range_changes[self.is_horizontal_distance, 2]
        )
        range_changes[self.is_horizontal_distance, 0] = change / cosine
        return range_changes


def shared_errors(recording: Recording) -> tuple[SharedErrors, ...]:
    """Shared errors that a recording declares in columns `shared_NAME_...`; an empty cell there means no error."""
    columns = {name: parts for name in recording.covariates if (parts := SHARED_ERROR_COLUMN_PATTERN.fullmatch(name))}
    names = list(dict.fromkeys(parts[1] for parts in columns.values()))
    if not names:
        return ()
    range_changes = np.zeros((len(recording), len(OBSERVABLES), len(names)))
    for name, parts in columns.items():
        k = OBSERVABLE_NAMES_WITH_UNIT.index(parts[2])
        range_changes[:, k, names.index(parts[1])] = np.nan_to_num(recording.covariates[name]) * SIGMA_UNITS[k]
    return (SharedErrors(range_changes, recording.is_horizontal_distance),)


@dataclass(frozen=True)
class Refraction(LinearEffect):
    """Refraction of lines of sight near the ground, with a prior for the coefficient of refraction.

    The coefficient k is the radius R of the earth divided by the radius of curvature of the line of sight. A line of
    sight of length d starts at the angle k d / (2 R) above its chord, so that the target appears higher.
    """

    mean_coefficient: float
    """Expected coefficient of refraction."""
    coefficient_sigma: float
    """Standard deviation of the coefficient of refraction."""

    @property
    def name(self) -> str:
        """Name of the refraction in lists of nuisance errors."""
        return "refraction"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Only parameter: the coefficient of refraction minus its mean, with its prior standard deviation."""
        return (Parameter("refraction", "", "coefficient of refraction", self.coefficient_sigma),)

    def design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, 1) of the raw readings of n pointings with respect to the coefficient of refraction."""
        _, across, up = sightings.beam_vectors
        bend = -sightings.range_ / (2.0 * EARTH_RADIUS)  # negative, because it is a correction
        azimuth = bend * across[:, 2] / np.cos(sightings.elevation)
        return design_from_front_face_corrections(sightings, azimuth=azimuth, elevation=bend * up[:, 2])[:, :, None]

    def reading_change(self, sightings: Sightings, parameter_values: Floats) -> Floats:
        """Change (n, 3) of the readings of n pointings for the mean coefficient plus `parameter_values` (1,)."""
        return self.design(sightings) @ (self.mean_coefficient + parameter_values)


def refraction_unknowns(recording: Recording) -> tuple[Refraction, ...]:
    """Refraction as an unknown, in a tuple; empty if the set-up declares no coefficient with a standard deviation."""
    declared_refraction = recording.setup.refraction
    return () if declared_refraction is None else (Refraction(*declared_refraction),)
