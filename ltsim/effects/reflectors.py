"""Errors of a reflector itself."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage, by_displacement, on_readings
from ltsim.errors import ModelError
from ltsim.scene.sightings import Sightings
from ltsim.units import DEGREE, MICROMETRE, MICRORADIAN

UP = np.array([0.0, 0.0, 1.0])


def reflector_axes(sightings: Sightings) -> Floats:
    """(n, 3, 3): axial, side and up of each pointing's reflector as columns, in the network frame.

    Re-aimed, and where the nest is unknown, the axis looks at the station; otherwise along the nest's normal.
    """
    normal = sightings.nest_normal[sightings.target]
    turned = sightings.reaimed[sightings.target] | ~np.isfinite(normal).all(axis=1)
    axial = np.where(turned[:, None], -sightings.unit_vectors[0], normal)
    side = np.cross(UP, axial)
    flat = np.linalg.norm(side, axis=1) < 1e-6
    side[flat] = [1.0, 0.0, 0.0]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.stack([axial, side, np.cross(axial, side)], axis=2)


@dataclass(frozen=True)
class SmrCentring(Effect):
    """Centring of a reflector: the vertex of its mirrors is not the centre of its sphere.

    The tracker measures the vertex, off the centre by e = axial a + side s + up p, axial along the open face: Delta_d =
    e_axial cos(alpha) + e_t sin(alpha) cos(chi - chi_0), lateral -e_perp, alpha the incidence off the axis and chi its
    direction around it. A fixed reflector (not re-aimed) keeps e in its nest; a re-aimed one turns its axis to the
    tracker, so the axial part is a range zero and the rest a lateral constant that does not flip with the face (its
    mark held up; a free roll makes it noise).

    Size: 2.5 um in a good reflector, 12 to 25 um in a bad one.
    Like: fixed: the target's position, exactly. Re-aimed: range-offset, exactly (axial, all); beam-offset (one face).
    Separate by: the reflector turned by 4 x 90 deg in one nest, or swapped.
    Valid: up to 25 um; independent of where the beam hits.
    Source: patent US 2015/0285615 A1 (run-out and the mark that keeps it still); Yan et al. 2010 (geometric errors of a
    spherically mounted reflector); the law follows from a ray trace of three mirrors.
    Status: validated: fixed is a displacement, re-aimed axial a range offset.
    """

    name = "smr-centring"
    stage = Stage.TARGET
    covariates = ("incidence", "place")
    scope = "target"
    plural = True
    parameters = (
        Parameter("vertex-axial", "um", "vertex outwards of the centre, along the open face", 15 * MICROMETRE),
        Parameter("vertex-side", "um", "vertex to the side, horizontally", 15 * MICROMETRE),
        Parameter("vertex-up", "um", "vertex upwards", 15 * MICROMETRE),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """One reflector for all, and each target its own."""
        return [cls(), *(cls((), (name,)) for name in sightings.target_names)]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 3) of the raw readings per unit of offset."""
        return by_displacement(sightings, reflector_axes(sightings) * self.mask(sightings)[:, None, None])


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
        """Change (n, 3, 5) of the raw readings per unit of each parameter, first order."""
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


@dataclass(frozen=True)
class SmrDihedral(Effect):
    """Dihedral error of a reflector: two mirrors do not meet at a right angle, and the return spot splits.

    The six sub-beams part by up to 1.63 delta; their mean stays unless the spot is clipped or a coating is uneven. Then
    the tracker holds the spot's brighter part, off by a share of 1.63 delta d: a constant angle for that reflector and
    roll, Delta_azimuth = left / cos(el), Delta_elevation = up, the same on both faces. The range does not change.

    Size: delta is 10 urad in a good reflector, 50 urad in a bad one; the clipped share a few percent of that.
    Like: detector-offset at one target, turbulence (if the roll is free).
    Separate by: the reflector turned about the beam.
    Valid: the reflector keeps its mark up; the clipped share is empirical.
    Source: the knowledge base of FARO on dihedral errors of a reflector; 1.63 from a ray trace of three mirrors.
    Status: form validated by its parity; the size is empirical.
    """

    name = "smr-dihedral"
    stage = Stage.TARGET
    observables = ("azimuth", "elevation")
    covariates = ("distance", "place")
    scope = "target"
    plural = True
    parameters = (
        Parameter("spot-left", "urad", "correction of the direction to the left", 3 * MICRORADIAN),
        Parameter("spot-up", "urad", "correction of the direction upwards", 3 * MICRORADIAN),
    )

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 2) of the raw readings per unit of direction."""
        acts = self.mask(sightings)
        left = on_readings(sightings, azimuth=acts / np.cos(sightings.elevation))
        return np.stack([left, on_readings(sightings, elevation=acts)], axis=2)
