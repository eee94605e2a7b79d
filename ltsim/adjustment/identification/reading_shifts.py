"""Shifts of readings: offsets, drifts and scale errors of one observable, at stations or targets, from a time on."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE, MICRORADIAN, PPM
from ltsim.geometry.rigid import pose_jacobian
from ltsim.physics.effects.linear_effect import (
    LinearEffect,
    Linearisation,
    Parameter,
    design_from_front_face_corrections,
)
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class ReadingShift(LinearEffect):
    """Shift of the readings of one observable by an offset, drift or scale error, at some stations or targets.

    An offset of the elevations is an error of the vertical index, whose sign in the raw elevations depends on the face.
    A drift grows at a constant rate from zero at the first pointing of each station, or of the recording; its parameter
    is the largest shift, at the end of the longest occupation of a station or at the end of the recording.
    """

    observable: str
    """Name of the shifted observable: `distance`, `azimuth` or `elevation`."""
    is_proportional: bool = False
    """True for a scale error, which is proportional to the range; False for an offset or drift."""
    stations: tuple[str, ...] = ()
    """Names of the stations whose readings are shifted; empty for all."""
    targets: tuple[str, ...] = ()
    """Names of the targets whose readings are shifted; empty for all."""
    onset_time: float = -np.inf
    """Time [s] from which the readings are shifted; minus infinity for all readings."""
    plausible_size_factor: float = 1.0
    """Factor on the plausible size of the parameter and thus on the standard deviation of its weak prior."""
    drift_interval: Literal["occupation", "recording"] | None = None
    """Interval in which the shift grows at a constant rate from zero; None for a constant shift."""

    @property
    def is_drift(self) -> bool:
        """True if the shift grows with time at a constant rate."""
        return self.drift_interval is not None

    @property
    def name(self) -> str:
        """Name of the kind of error: `scale-error`, `constant-drift` or `constant-offset`."""
        return "scale-error" if self.is_proportional else "constant-drift" if self.is_drift else "constant-offset"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameter of the shift, as a tuple with one element: offset [m or rad] or scale error of the readings."""
        if self.is_proportional:
            return (Parameter("scale-error", "ppm", "scale error of the readings", PPM),)
        if self.observable == "distance":
            return (Parameter("offset", "um", "offset of the readings", 10 * MICROMETRE),)
        return (Parameter("offset", "urad", "offset of the readings", 10 * MICRORADIAN),)

    @property
    def plausible_sizes(self) -> Floats:
        """Plausible size (1,) of the parameter [SI]."""
        return self.plausible_size_factor * super().plausible_sizes

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings of n pointings per unit [SI] of the parameter."""
        is_shifted = self.pointing_indicator(sightings) * (sightings.time >= self.onset_time)
        if self.is_drift:
            elapsed = sightings.time_since_station_start
            if self.drift_interval == "recording":
                elapsed = sightings.time - float(sightings.time[is_shifted > 0].min(initial=np.inf))
            elapsed = np.where(is_shifted > 0, elapsed, 0.0)
            is_shifted = elapsed / (float(elapsed.max(initial=0.0)) or 1.0)  # readings made at one time do not drift
        shift_per_unit = is_shifted * sightings.range_ if self.is_proportional else is_shifted
        shift_per_unit = shift_per_unit * sightings.face_sign if self.observable == "elevation" else shift_per_unit
        return design_from_front_face_corrections(sightings, **{self.observable: -shift_per_unit[:, None]})

    def linearise(self, sightings: Sightings, parameter_values: Floats) -> Linearisation:
        """Change of the readings, and its derivatives, at the value `parameter_values` (1,) [SI] of the parameter.

        The change by a scale error is proportional to the range, so that it also depends on poses and targets.
        """
        design = self.design(sightings)
        if not self.is_proportional:
            return Linearisation(design @ parameter_values, design)
        scaled = np.where(design != 0.0, parameter_values[0] * sightings.target_derivatives, 0.0)
        return Linearisation(
            design @ parameter_values, design, (scaled, pose_jacobian(scaled, sightings.sight_vectors))
        )
