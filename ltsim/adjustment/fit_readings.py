"""Readings for the fit of the pose of one station, or of one point, converted to face 1."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.polar import polar_jacobian, swap_front_and_raw, to_polar, wrap_angle
from ltsim.physics.model.measurement import reduce_to_horizontal, sight_vector_offsets
from ltsim.recordings.recording import Recording

MAX_POINTINGS_PER_FIT = 12
"""Largest number of pointings in the fit of a pose or point; of more pointings, evenly spaced ones are selected."""
SIGMA_OF_APPROXIMATE_FITS = 1e-4
"""Standard deviation of all readings in fits of approximate coordinates: as a fraction of a range, in rad for
angles."""


@dataclass(frozen=True)
class FitReadings:
    """Readings of k pointings for the fit of the pose of one station or of one point."""

    readings: Floats
    """Readings of k pointings converted to face 1, (k, 3) [m, rad, rad]; NaN if not measured."""
    has_horizontal_distance: Bools
    """Flags (k,), True for those of the k pointings with a horizontal distance instead of a slope distance."""
    sight_vector_offsets: Floats
    """Offsets (k, 3) [m] of k sight vectors in the network frame: offset of the reflector from its target point minus
    offset of the instrument from its station point, for example by heights over marks."""

    @classmethod
    def from_recording(cls, recording: Recording) -> Self:
        """Readings of all pointings of a recording, converted to face 1."""
        lift = sight_vector_offsets(recording)
        lift = np.zeros((len(recording), 3)) if lift is None else lift
        return cls(swap_front_and_raw(recording.readings, recording.face), recording.is_horizontal_distance, lift)

    @property
    def n_readings(self) -> int:
        """Number of readings that are not NaN."""
        return int(np.isfinite(self.readings).sum())

    @property
    def only_azimuths(self) -> FitReadings:
        """Readings of the same pointings with the azimuths only; distances and elevations are NaN."""
        return replace(self, readings=np.where([False, True, False], self.readings, np.nan))

    def without_observable(self, observable: int) -> FitReadings:
        """Copy of the readings without one observable: distances (`observable` 0), azimuths (1) or elevations (2)."""
        return replace(self, readings=np.where(np.arange(3) == observable, np.nan, self.readings))

    def select_rows(self, rows: Ints) -> Self:
        """Readings of some pointings, those with the indices `rows`."""
        return replace(
            self,
            readings=self.readings[rows],
            has_horizontal_distance=self.has_horizontal_distance[rows],
            sight_vector_offsets=self.sight_vector_offsets[rows],
        )

    def select_evenly(self) -> tuple[Ints, FitReadings]:
        """Indices of at most `MAX_POINTINGS_PER_FIT` pointings, evenly spaced in the list, and their readings."""
        k = len(self.readings)
        thinned_rows = (
            np.arange(k)
            if k <= MAX_POINTINGS_PER_FIT
            else np.linspace(0, k - 1, MAX_POINTINGS_PER_FIT).astype(np.int64)
        )
        return thinned_rows, self.select_rows(thinned_rows)

    def residuals(self, local_points: Floats) -> tuple[Floats, Floats]:
        """Whitened residuals (b, 3 k) of k pointings for b trial solutions, and their derivatives (b, 3 k, 3).

        The derivatives are those with respect to the coordinates of the points.
        `local_points` (b, k, 3) [m] are the positions of the reflectors in the instrument frame, for each trial
        solution.
        """
        size, rows = local_points.shape[:2]
        polar = to_polar(local_points.reshape(-1, 3))
        point_derivatives = polar_jacobian(polar, np.ones(len(polar), dtype=np.int64))
        range_ = polar[:, 0].reshape(size, rows).copy()
        reduce_to_horizontal(polar, (point_derivatives,), np.tile(self.has_horizontal_distance, size))
        point_derivatives, polar = point_derivatives.reshape(size, rows, 3, 3), polar.reshape(size, rows, 3)
        gap = self.readings - polar
        gap[:, :, 1:] = wrap_angle(gap[:, :, 1:])
        scale = (
            np.stack([1.0 / range_, np.cos(polar[:, :, 2]), np.ones_like(range_)], axis=2) / SIGMA_OF_APPROXIMATE_FITS
        )
        gap, point_derivatives = gap * scale, point_derivatives * scale[..., None]
        unread = np.isnan(self.readings)
        gap[:, unread], point_derivatives[:, unread] = 0.0, 0.0
        return gap.reshape(size, -1), point_derivatives.reshape(size, -1, 3)
