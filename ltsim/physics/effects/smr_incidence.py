from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings

INCIDENCE_TABLE_ANGLES = np.arange(-30.0, 30.1, 7.5) * DEGREE
"""Incidence angles [rad] of a bench-test table with the range errors of a reflector, as in fig. 9 of Sensors 2021,
21, 7479."""
MAX_TABULATED_INCIDENCE = 30.0 * DEGREE
"""Largest incidence angle [rad] in a bench-test table with the range errors of a reflector."""
PAPER_INCIDENCE_RANGE_ERRORS = tuple(x * MICROMETRE for x in (13.0, 8.6, 4.9, 3.4, 2.9, 3.1, 3.6, 5.8, 8.2))
"""Range errors (reading - true range) [m] of a reflector at the angles `INCIDENCE_TABLE_ANGLES`, with the size and
the asymmetry of fig. 9 of Sensors 2021, 21, 7479."""
INCIDENCE_KNOT_ANGLES = INCIDENCE_TABLE_ANGLES[len(INCIDENCE_TABLE_ANGLES) // 2 : -1]
"""Incidence angles (4,) [rad] at which the slope of the range error may change: the angles of
`INCIDENCE_TABLE_ANGLES` from 0 up, except the last one."""
EVEN_SLOPE_CHANGE_PRIOR_SIGMA = 1.5 * MICROMETRE
"""Prior standard deviation [m] of a change of slope in the even part of the incidence error (the part that is the
same for all directions). The change of slope is expressed as the resulting error 7.5 deg further. At 30 deg the even
part then has a standard deviation of 8.2 um; in `PAPER_INCIDENCE_RANGE_ERRORS` it is 7.7 um."""
ODD_SLOPE_CHANGE_PRIOR_SIGMA = 0.6 * MICROMETRE
"""Prior standard deviation [m] of a change of slope in an odd part of the incidence error (a part with opposite
values for opposite directions). The change of slope is expressed as the resulting error 7.5 deg further. At 30 deg
an odd part then has a standard deviation of 3.3 um; in `PAPER_INCIDENCE_RANGE_ERRORS` it is 2.4 um."""
THREEFOLD_PART_PRIOR_SIGMA = 5 * MICROMETRE
"""Prior standard deviation [m] of the part of the incidence error with three periods per turn around the normal of
the nest. The three mirrors of the reflector cause this part."""
INCIDENCE_ERROR_PARTS = ("even", "cos", "sin")
"""Parts of the incidence error by their dependence on the direction of incidence: `even` (none), `cos` (its cosine)
and `sin` (its sine)."""
_PART_DESCRIPTIONS = (
    "the same for all directions",
    "for beams from the right, seen from the front of the nest, of opposite sign from the left",
    "for beams from above, of opposite sign from below",
)
"""Descriptions, shown to users, of the parts of the incidence error in `INCIDENCE_ERROR_PARTS`: the directions in which
they change the range."""


def _ramp_parameters() -> tuple[Parameter, ...]:
    """Parameters of the incidence error: for each part, sizes at 30 deg of ramps from 0, 7.5, 15 and 22.5 deg."""
    steps = range(len(INCIDENCE_KNOT_ANGLES), 0, -1)
    return tuple(
        Parameter(
            f"{part}-{number}", "um", f"range error at 30 deg by a ramp from {knot:g} deg, {meaning}", step * bend
        )
        for part, meaning, bend in zip(
            INCIDENCE_ERROR_PARTS,
            _PART_DESCRIPTIONS,
            (EVEN_SLOPE_CHANGE_PRIOR_SIGMA, ODD_SLOPE_CHANGE_PRIOR_SIGMA, ODD_SLOPE_CHANGE_PRIOR_SIGMA),
            strict=True,
        )
        for number, knot, step in zip(
            ("first", "second", "third", "fourth"), INCIDENCE_KNOT_ANGLES / DEGREE, steps, strict=True
        )
    )


def _ramp_values(incidence: Floats) -> Floats:
    """Values (n, 4) of four ramps at n incidence angles (n,) [rad].

    A ramp is 0 up to its knot angle (one of `INCIDENCE_KNOT_ANGLES`), and rises linearly to 1 at 30 deg.
    """
    return np.clip(
        (incidence[:, None] - INCIDENCE_KNOT_ANGLES) / (MAX_TABULATED_INCIDENCE - INCIDENCE_KNOT_ANGLES), 0.0, 1.0
    )


@dataclass(frozen=True)
class SmrIncidence(Effect):
    """Incidence-angle error of a reflector: the range depends on the angle between open face and beam.

    The correction (true value minus reading) of the range is Delta_d = even(alpha) + cos(chi) c(alpha) + sin(chi)
    s(alpha) + (c3 cos 3 chi + s3 sin 3 chi) sin^3(alpha). Here alpha is the angle of incidence and chi its direction
    around the nest's normal, 0 to the right and pi/2 upward seen from the front. The functions even, c and s are
    piecewise linear with knots every 7.5 deg, as a test on a roundness table with an interferometer gives them. Each
    parameter of these functions is a change of slope at one knot, expressed as the resulting range error at 30 deg. A
    table of signed incidence angles along the direction chi_0 corresponds to even(alpha) + odd(alpha) cos(chi - chi_0).
    The term in 3 chi comes from the three mirrors. The error at normal incidence belongs to the range zero, which is
    determined with the reflector facing the beam. The error at normal incidence is therefore subtracted from the table,
    and a reflector that is turned to the tracker has no error.

    Size: table of Sensors 2021, 21, 7479: about 3 um in the middle, up to 13 um at the edge of the negative side, no
    symmetry; a good reflector 1.3 um.
    Similar to: beam-offset (linear form, correlation 0.84 in one face, 0 in two), range zero of one station (0.51).
    Separate by: two faces; one station with the reflectors re-aimed; a log of how each reflector was turned.
    Validity: up to 30 deg, beyond which the beam is lost; one reflector that is carried to all nests with its marker in
    the same direction.
    Source: Sensors 2021, 21, 7479, doi:10.3390/s21227479, sections 2.2 and 3.1, fig. 9 (size, asymmetry); Sabatke et
    al. 2009, Proc. SPIE 7461 (polarisation in a retroreflector and an absolute meter).
    Validation: validated against the table at its angles, and against the geometry of the sightings.
    """

    table: tuple[float, ...] = ()
    """Range errors (reading - true range) [m] at the angles `INCIDENCE_TABLE_ANGLES`, up to a common constant. If
    empty, the parameters alone define the error."""
    direction: float = 0.0
    """Direction chi_0 [rad] around the normal of the nest to which positive angles of the table belong: 0 to the right
    and pi/2 upward, seen from the front of the nest."""

    name: ClassVar[str] = "smr-incidence"
    light_path_stage: ClassVar[LightPathStage] = LightPathStage.TARGET
    observables: ClassVar[tuple[str, ...]] = ("distance",)
    covariates: ClassVar[tuple[str, ...]] = ("incidence",)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        *_ramp_parameters(),
        Parameter(
            "threefold-cos",
            "um",
            "cosine part of the error of three mirrors, amplitude at 30 deg",
            THREEFOLD_PART_PRIOR_SIGMA,
        ),
        Parameter(
            "threefold-sin",
            "um",
            "sine part of the error of three mirrors, amplitude at 30 deg",
            THREEFOLD_PART_PRIOR_SIGMA,
        ),
    )

    def __post_init__(self) -> None:
        if self.table and len(self.table) != len(INCIDENCE_TABLE_ANGLES):
            raise ModelError(
                f"smr-incidence.table has {len(self.table)} values, expected {len(INCIDENCE_TABLE_ANGLES)}"
            )

    @classmethod
    def range_correction_design(cls, incidence: Floats, direction: Floats) -> Floats:
        """Derivatives (n, 14) of the range correction (true range - reading) in n pointings by the 14 parameters.

        `incidence` and `direction` (n,) [rad] are the angle of incidence and its direction around the normal of the
        nest (0 to the right, pi/2 upward, seen from the front).
        """
        ramps, cubed = (
            _ramp_values(incidence),
            (np.sin(np.minimum(incidence, MAX_TABULATED_INCIDENCE)) / np.sin(MAX_TABULATED_INCIDENCE)) ** 3,
        )
        once = np.exp(1j * direction[:, None])
        thrice = cubed[:, None] * once**3
        around = ramps * once.real, ramps * once.imag, thrice.real, thrice.imag
        return np.concatenate([ramps, *around], axis=1)

    @cached_property
    def parameter_values_of_table(self) -> Floats:
        """Parameters (14,) [m] that give the range corrections of `table`; zeros without a table."""
        if not self.table:
            return np.zeros(len(self.parameters))
        middle_index = len(INCIDENCE_TABLE_ANGLES) // 2
        upper = np.array(self.table[middle_index + 1 :]) - self.table[middle_index]
        lower = np.array(self.table[:middle_index][::-1]) - self.table[middle_index]
        at_knots = _ramp_values(np.append(INCIDENCE_KNOT_ANGLES[1:], MAX_TABULATED_INCIDENCE))
        even, odd = np.linalg.solve(at_knots, 0.5 * np.stack([upper + lower, upper - lower], axis=1)).T
        odds = odd * np.cos(self.direction), odd * np.sin(self.direction)
        return -np.concatenate([even, *odds, np.zeros(2)])

    def incidence_angle_and_direction(self, sightings: Sightings) -> tuple[Floats, Floats]:
        """Angle of incidence, and its direction around the normal of the nest, in n pointings, each (n,) [rad].

        The direction is 0 to the right and pi/2 upward, seen from the front of the nest. Angle and direction are 0 for
        a reflector that is turned to the tracker, and for a nest with an unknown normal.
        """
        fixed = ~sightings.is_reaimed[sightings.target] & np.isfinite(sightings.incidence_angle)
        angle = np.where(fixed, sightings.incidence_angle, 0.0)
        direction = np.where(fixed, sightings.incidence_direction, 0.0)
        return angle, direction

    def design(self, sightings: Sightings) -> Floats:
        acts = self.pointing_indicator(sightings)[:, None]
        return design_from_front_face_corrections(
            sightings, distance=acts * self.range_correction_design(*self.incidence_angle_and_direction(sightings))
        )

    def reading_change(self, sightings: Sightings, parameter_values: Floats) -> Floats:
        """Change (n, 3) [m, rad, rad] of the raw readings of n pointings by the incidence error; only ranges change.

        The error is the one of `table` plus the one of `parameter_values` (14,) [m].
        """
        change: Floats = self.design(sightings) @ (self.parameter_values_of_table + parameter_values)
        return change
