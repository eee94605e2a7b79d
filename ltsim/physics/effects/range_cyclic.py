from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import (
    Effect,
    LightPathStage,
    Parameter,
    ShapeParameter,
    design_from_front_face_corrections,
)
from ltsim.scene.sightings import Sightings

MIN_CANDIDATE_WAVELENGTH = 0.02
"""Shortest wavelength [m] of a cyclic range error that a diagnosis tries."""
MAX_CANDIDATE_WAVELENGTH = 2.0
"""Longest wavelength [m] of a cyclic range error that a diagnosis tries."""
MAX_CANDIDATE_WAVE_PHASE_ERROR = 0.125
"""Largest phase error [periods] of the nearest wavelength that a diagnosis tries, for a wave of any wavelength. It
determines the spacing of the wavelengths. The error occurs at both ends of the interval of measured ranges if the phase
is right in the middle."""
MAX_N_CANDIDATE_WAVELENGTHS = 1200
"""Largest number of wavelengths of a cyclic range error that a diagnosis tries."""


@dataclass(frozen=True)
class RangeCyclic(Effect):
    """Cyclic range error: crosstalk of the modulation, periodic in the range with its unit length.

    The correction (true value minus reading) of the range d is Delta_d = A cos(2 pi d / L) + B sin(2 pi d / L). The
    unit length is L = c / (2 n f), with the speed of light c, the refractive index n and the modulation frequency f: L
    is 150 mm at 1 GHz and 53.5 mm at 2.8 GHz. Ranges that differ by L have the same error.

    Size: under 1 um in a good meter, 5 to 10 um in a bad one.
    Similar to: noise that repeats. If the effect is not modelled, it biases the range zero.
    Separate by: one reflector that is moved on a rail over one unit length; the modulation frequency (data sheet).
    Validity: L from 20 mm to 2 m. A network distinguishes wavelengths whose phases differ over its interval of ranges.
    The wavelength of an interferometer, 0.3 um, cannot be determined.
    Source: Rüeger 1996, Electronic Distance Measurement (unit length; zero and cyclic terms are estimated together);
    Lichti 2007, ISPRS J. Photogramm. Remote Sens. 61, 307-324, doi:10.1016/j.isprsjprs.2006.10.004.
    Validation: wave and sign validated; the spacing of wavelengths in the search was tested by the power lost between
    them.
    """

    wavelength: float = 0.15
    """Unit length L [m], the period of the error in the range."""

    name = "range-cyclic"
    light_path_stage = LightPathStage.RANGE
    observables = ("distance",)
    covariates = ("distance",)
    parameters = (
        Parameter("cyclic-cos", "um", "cosine of the range's phase", 8 * MICROMETRE),
        Parameter("cyclic-sin", "um", "sine of the range's phase", 8 * MICROMETRE),
    )
    shape_parameters = (
        ShapeParameter(
            "wavelength",
            "mm",
            "unit length",
            MIN_CANDIDATE_WAVELENGTH,
            MAX_CANDIDATE_WAVELENGTH,
            n_grid_values=600,
            has_reciprocal_grid=True,
        ),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Cyclic errors that a diagnosis tries, with the wavelengths that the measured ranges can distinguish."""
        span = float(np.ptp(sightings.range_)) if len(sightings) else 0.0
        step = 4 * MAX_CANDIDATE_WAVE_PHASE_ERROR / max(span, 0.5)
        highest = min(1 / MIN_CANDIDATE_WAVELENGTH, 1 / MAX_CANDIDATE_WAVELENGTH + MAX_N_CANDIDATE_WAVELENGTHS * step)
        return [cls(wavelength=float(1 / f)) for f in np.arange(1 / MAX_CANDIDATE_WAVELENGTH, highest, step)]

    def design(self, sightings: Sightings) -> Floats:
        phase = 2 * np.pi * sightings.range_ / self.wavelength
        acts = self.pointing_indicator(sightings)
        columns = [
            design_from_front_face_corrections(sightings, distance=acts * wave(phase)) for wave in (np.cos, np.sin)
        ]
        return np.stack(columns, axis=2)
