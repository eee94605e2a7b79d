"""Readings for the fit of one pose or point, converted to the front face."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.polar import polar_jacobian, to_face, to_polar, wrap_angle
from ltsim.physics.model.measurement import reduce_to_horizontal, reflector_offsets
from ltsim.recordings.recording import Recording

MAX_FIT_ROWS = 12
"""Largest number of rows in a fit, selected evenly."""
APPROXIMATE_SIGMA = 1e-4
"""Standard deviation [fraction of the range, rad] of all readings while coordinates are approximate."""


@dataclass(frozen=True)
class FitReadings:
    """Rows for one fit: front-face readings (k, 3) [m, rad, rad], NaN if not measured.

    Flags of horizontal distances.
    """

    readings: Floats
    """Front-face readings, (k, 3) [m, rad, rad]; NaN if not measured."""
    is_horizontal: Bools
    reflector_offsets: Floats

    @classmethod
    def from_recording(cls, recording: Recording) -> Self:
        """Sight with all rows of a recording."""
        lift = reflector_offsets(recording)
        lift = np.zeros((len(recording), 3)) if lift is None else lift
        return cls(to_face(recording.readings, recording.face), recording.is_horizontal, lift)

    @property
    def n_readings(self) -> int:
        """Number of readings."""
        return int(np.isfinite(self.readings).sum())

    @property
    def azimuths_only(self) -> FitReadings:
        """Sight with the azimuths alone."""
        return replace(self, readings=np.where([False, True, False], self.readings, np.nan))

    def without_observable(self, observable: int) -> FitReadings:
        """The same sight without its distances (0), azimuths (1) or elevations (2)."""
        return replace(self, readings=np.where(np.arange(3) == observable, np.nan, self.readings))

    def select_rows(self, rows: Ints) -> Self:
        """Sight with some of the rows."""
        return replace(
            self,
            readings=self.readings[rows],
            is_horizontal=self.is_horizontal[rows],
            reflector_offsets=self.reflector_offsets[rows],
        )

    def thin_rows(self) -> tuple[Ints, FitReadings]:
        """Selection of at most `MAX_FIT_ROWS` rows, and the sight with these."""
        k = len(self.readings)
        rows = np.arange(k) if k <= MAX_FIT_ROWS else np.linspace(0, k - 1, MAX_FIT_ROWS).astype(np.int64)
        return rows, self.select_rows(rows)

    def residuals(self, local_points: Floats) -> tuple[Floats, Floats]:
        """Residuals (b, 3 k) relative to the range, and their derivatives (b, 3 k, 3) by local points (b, k, 3)."""
        size, rows = local_points.shape[:2]
        polar = to_polar(local_points.reshape(-1, 3))
        by = polar_jacobian(polar, np.ones(len(polar), dtype=np.int64))
        range_ = polar[:, 0].reshape(size, rows).copy()
        reduce_to_horizontal(polar, (by,), np.tile(self.is_horizontal, size))
        by, polar = by.reshape(size, rows, 3, 3), polar.reshape(size, rows, 3)
        gap = self.readings - polar
        gap[:, :, 1:] = wrap_angle(gap[:, :, 1:])
        scale = np.stack([1.0 / range_, np.cos(polar[:, :, 2]), np.ones_like(range_)], axis=2) / APPROXIMATE_SIGMA
        gap, by = gap * scale, by * scale[..., None]
        unread = np.isnan(self.readings)
        gap[:, unread], by[:, unread] = 0.0, 0.0
        return gap.reshape(size, -1), by.reshape(size, -1, 3)
