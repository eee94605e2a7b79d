from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage, on_readings
from ltsim.errors import ModelError
from ltsim.scene.sightings import Sightings
from ltsim.units import DEGREE, MICROMETRE

TABLE_ANGLES = np.arange(-30.0, 30.1, 7.5) * DEGREE
EDGE = 30.0 * DEGREE
PAPER_TABLE = tuple(x * MICROMETRE for x in (13.0, 8.6, 4.9, 3.4, 2.9, 3.1, 3.6, 5.8, 8.2))
"""Range error (reading - truth) [m] at `TABLE_ANGLES`: size and asymmetry of the paper's fig. 9."""
_SIZE = 5 * MICROMETRE


def _edge_parameter(name: str, meaning: str) -> Parameter:
    return Parameter(name, "um", meaning + ", its size at 30 deg", _SIZE)


@dataclass(frozen=True)
class SmrIncidence(Effect):
    """Incidence-angle error of the reflector: the range depends on how the open face is turned to the beam.

    Exact: a table over the signed incidence, -30 to +30 deg in steps of 7.5 deg, as a roundness table and an
    interferometer give it. Off the plane in which the table was taken, even(alpha) + odd(alpha) cos(chi - chi_0). First
    order, for the search: Delta_d = (c1 cos chi + s1 sin chi) sin(alpha) + c2 alpha^2 + (c3 cos 3 chi + s3 sin 3 chi)
    sin^3(alpha), each by its size at 30 deg; the threefold term comes from the three mirrors. A re-aimed reflector
    faces the beam: the value at zero, the same for all, is left.

    Size: about 3 um in the middle, up to 13 um at the edge of the negative side, no symmetry; a good reflector 1.3 um.
    Like: beam-offset (linear form, 0.84 / 0), range zero of one station (0.51).
    Separate by: two faces; one station with the reflectors re-aimed; a log of how each reflector was turned.
    Valid: to 30 deg; beyond, the beam is lost. One reflector carried to all nests with its mark held alike.
    Source: Sensors 2021, 21, 7479, doi:10.3390/s21227479, sections 2.2 and 3.1, fig. 9 (size, asymmetry); Sabatke et
    al. 2009, Proc. SPIE 7461 (polarisation in a retroreflector and an absolute meter); the terms are a series in alpha
    and chi.
    Status: the table is met at its own angles; first order validated against the geometry of the sightings.
    """

    table: tuple[float, ...] = ()
    """[m]: range error (reading - truth) at `TABLE_ANGLES`; empty: the first-order form alone."""
    direction: float = 0.0
    """[rad], chi_0: where the table's positive side lies around the nest's normal."""

    name: ClassVar[str] = "smr-incidence"
    stage: ClassVar[Stage] = Stage.TARGET
    observables: ClassVar[tuple[str, ...]] = ("distance",)
    covariates: ClassVar[tuple[str, ...]] = ("incidence",)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        _edge_parameter("linear-cos", "proportional to the sine of the incidence, to the horizontal side"),
        _edge_parameter("linear-sin", "proportional to the sine of the incidence, to the upper side"),
        _edge_parameter("quadratic", "square of the incidence"),
        _edge_parameter("threefold-cos", "of the three mirrors, cosine"),
        _edge_parameter("threefold-sin", "of the three mirrors, sine"),
    )

    def __post_init__(self) -> None:
        if self.table and len(self.table) != len(TABLE_ANGLES):
            raise ModelError(f"smr-incidence.table has {len(self.table)} values, expected {len(TABLE_ANGLES)}")

    @cached_property
    def _even_and_odd(self) -> Callable[[Floats], Floats]:
        """Even and odd part (n, 2) of the table at angles (n,): monotone cubics."""
        from scipy.interpolate import PchipInterpolator  # half a second that the catalogue need not wait for

        values = np.array(self.table)
        return PchipInterpolator(TABLE_ANGLES, 0.5 * np.stack([values + values[::-1], values - values[::-1]], axis=1))

    def table_error(self, incidence: Floats, direction: Floats) -> Floats:
        """Range error (n,) [m] at incidence (n,) [rad] and direction (n,) [rad] from the table's positive side.

        Beyond 30 deg the value at the edge stays.
        """
        even, odd = self._even_and_odd(np.clip(incidence, 0.0, EDGE)).T
        return even + odd * np.cos(direction)

    def incidence(self, sightings: Sightings) -> tuple[Floats, Floats]:
        """Incidence and direction (n,) [rad]; both 0 for a reflector that is re-aimed or whose nest is unknown."""
        fixed = ~sightings.reaimed[sightings.target] & np.isfinite(sightings.incidence)
        angle = np.where(fixed, sightings.incidence, 0.0)
        direction = np.where(fixed, sightings.incidence_direction, 0.0)
        return angle, direction

    def design(self, sightings: Sightings) -> Floats:
        angle, direction = self.incidence(sightings)
        slope, cubed = np.sin(angle) / np.sin(EDGE), (np.sin(angle) / np.sin(EDGE)) ** 3
        terms = (
            slope * np.cos(direction),
            slope * np.sin(direction),
            (angle / EDGE) ** 2,
            cubed * np.cos(3 * direction),
            cubed * np.sin(3 * direction),
        )
        acts = self.mask(sightings)
        return np.stack([on_readings(sightings, distance=acts * term) for term in terms], axis=2)

    def shift(self, sightings: Sightings, values: Floats) -> Floats:
        """Change (n, 3) of the raw readings: the table's error and the first-order terms."""
        change: Floats = self.design(sightings) @ values if np.any(values) else np.zeros((len(sightings), 3))
        if self.table:
            angle, direction = self.incidence(sightings)
            change[:, 0] += self.mask(sightings) * self.table_error(angle, direction - self.direction)
        return change
