from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.effect import Effect, Parameter, Stage, on_readings
from ltsim.scene.sightings import Sightings

TABLE_ANGLES = np.arange(-30.0, 30.1, 7.5) * DEGREE
EDGE = 30.0 * DEGREE
PAPER_TABLE = tuple(x * MICROMETRE for x in (13.0, 8.6, 4.9, 3.4, 2.9, 3.1, 3.6, 5.8, 8.2))
"""Range error (reading - truth) [m] at `TABLE_ANGLES`: size and asymmetry of the paper's fig. 9."""
KNOTS = TABLE_ANGLES[len(TABLE_ANGLES) // 2 : -1]
"""Angles (4,) [rad] at which the slope of the error may change: those of the table from normal incidence outwards."""
EVEN, ODD = 1.5 * MICROMETRE, 0.6 * MICROMETRE
"""Standard deviations [m] of a change of slope, as its contribution to the error at the next knot, in the even part and
in each odd part. At the edge the parts have standard deviations of 8.2 um and 3.3 um; in the paper's table they are 7.7
um and 2.4 um.
"""
THREEFOLD = 5 * MICROMETRE
PARTS = ("even", "cos", "sin")
_MEANINGS = ("alike on all sides", "to the horizontal side, opposite on the other", "to the upper side, opposite below")


def _ramp_parameters() -> tuple[Parameter, ...]:
    """Parameters of the three parts of the error, each a ramp from a knot to its size at 30 deg."""
    steps = range(len(KNOTS), 0, -1)
    return tuple(
        Parameter(f"{part}-{number}", "um", f"{meaning}, from {knot:g} deg on, its size at 30 deg", step * bend)
        for part, meaning, bend in zip(PARTS, _MEANINGS, (EVEN, ODD, ODD), strict=True)
        for number, knot, step in zip(("first", "second", "third", "fourth"), KNOTS / DEGREE, steps, strict=True)
    )


def _ramps(incidence: Floats) -> Floats:
    """Ramps (n, 4) at incidence (n,) [rad]: 0 up to each knot, 1 from 30 deg on."""
    return np.clip((incidence[:, None] - KNOTS) / (EDGE - KNOTS), 0.0, 1.0)


@dataclass(frozen=True)
class SmrIncidence(Effect):
    """Incidence-angle error of a reflector: the range depends on the angle between open face and beam.

    With alpha the incidence and chi its direction around the nest's normal, Delta_d = even(alpha) + cos(chi) c(alpha) +
    sin(chi) s(alpha) + (c3 cos 3 chi + s3 sin 3 chi) sin^3(alpha). The first three are linear between the angles of a
    table in steps of 7.5 deg, as a roundness table and an interferometer give it; a parameter is the change of slope at
    one of these angles by its size at 30 deg. A table of signed incidences along the direction chi_0 is even(alpha) +
    odd(alpha) cos(chi - chi_0). The threefold term comes from the three mirrors. The error at normal incidence is part
    of the range zero, which is set with the reflector facing the beam: it is taken off the table, and a re-aimed
    reflector has no error.

    Size: table of the paper: about 3 um in the middle, up to 13 um at the edge of the negative side, no symmetry; a
    good reflector 1.3 um.
    Like: beam-offset (linear form, 0.84 / 0), range zero of one station (0.51).
    Separate by: two faces; one station with the reflectors re-aimed; a log of how each reflector was turned.
    Valid: to 30 deg; beyond, the beam is lost. One reflector carried to all nests with its mark held alike.
    Source: Sensors 2021, 21, 7479, doi:10.3390/s21227479, sections 2.2 and 3.1, fig. 9 (size, asymmetry); Sabatke et
    al. 2009, Proc. SPIE 7461 (polarisation in a retroreflector and an absolute meter).
    Status: the table is met at its own angles; validated against the geometry of the sightings.
    """

    table: tuple[float, ...] = ()
    """Range error (reading - truth) [m] at `TABLE_ANGLES`, relative to any zero; empty: the parameters alone give the
    error.
    """
    direction: float = 0.0
    """Direction chi_0 [rad] around the nest's normal to which the table's positive side points."""

    name: ClassVar[str] = "smr-incidence"
    stage: ClassVar[Stage] = Stage.TARGET
    observables: ClassVar[tuple[str, ...]] = ("distance",)
    covariates: ClassVar[tuple[str, ...]] = ("incidence",)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        *_ramp_parameters(),
        Parameter("threefold-cos", "um", "of the three mirrors, cosine, its size at 30 deg", THREEFOLD),
        Parameter("threefold-sin", "um", "of the three mirrors, sine, its size at 30 deg", THREEFOLD),
    )

    def __post_init__(self) -> None:
        if self.table and len(self.table) != len(TABLE_ANGLES):
            raise ModelError(f"smr-incidence.table has {len(self.table)} values, expected {len(TABLE_ANGLES)}")

    @classmethod
    def terms(cls, incidence: Floats, direction: Floats) -> Floats:
        """Derivative (n, 14) of the range error (reading - truth) with respect to minus each parameter.

        Incidence and direction are (n,) [rad].
        """
        ramps, cubed = _ramps(incidence), (np.sin(np.minimum(incidence, EDGE)) / np.sin(EDGE)) ** 3
        once = np.exp(1j * direction[:, None])
        thrice = cubed[:, None] * once**3
        around = ramps * once.real, ramps * once.imag, thrice.real, thrice.imag
        return np.concatenate([ramps, *around], axis=1)

    @cached_property
    def values_of_table(self) -> Floats:
        """Parameters (14,) [m] that correspond to the table; they are corrections like all parameters."""
        if not self.table:
            return np.zeros(len(self.parameters))
        middle = len(TABLE_ANGLES) // 2
        upper = np.array(self.table[middle + 1 :]) - self.table[middle]
        lower = np.array(self.table[:middle][::-1]) - self.table[middle]
        at_knots = _ramps(np.append(KNOTS[1:], EDGE))
        even, odd = np.linalg.solve(at_knots, 0.5 * np.stack([upper + lower, upper - lower], axis=1)).T
        odds = odd * np.cos(self.direction), odd * np.sin(self.direction)
        return -np.concatenate([even, *odds, np.zeros(2)])

    def incidence(self, sightings: Sightings) -> tuple[Floats, Floats]:
        """Incidence angle and its direction, each (n,) [rad]; 0 for a re-aimed reflector and for an unknown nest."""
        fixed = ~sightings.reaimed[sightings.target] & np.isfinite(sightings.incidence)
        angle = np.where(fixed, sightings.incidence, 0.0)
        direction = np.where(fixed, sightings.incidence_direction, 0.0)
        return angle, direction

    def design(self, sightings: Sightings) -> Floats:
        acts = self.mask(sightings)[:, None]
        return on_readings(sightings, distance=acts * self.terms(*self.incidence(sightings)))

    def shift(self, sightings: Sightings, values: Floats) -> Floats:
        """Change (n, 3) of the raw readings by the table and the parameters."""
        change: Floats = self.design(sightings) @ (self.values_of_table + values)
        return change
