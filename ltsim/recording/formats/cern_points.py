"""Points of CERN's LGC: which coordinates are fixed, known with a covariance or free, and what observes them.

``*POIN`` lines may end with ``SX``, ``SY``, ``SZ`` (standard deviations in mm, 0 for fixed; an axis without one is
free) or ``APRICOV DIAG(...)`` or ``MAT(...)`` (covariance in square metres). ``*OBSXYZ`` lines observe a point: its
coordinates and their standard deviations in mm. Independent observations of one point are one: their weighted mean.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.errors import RecordError
from ltsim.recording.files import check_name, number
from ltsim.recording.setup import Axes
from ltsim.units import MILLIMETRE

FIXED = 1e-7
"""[m] Standard deviation of a coordinate that is fixed."""
POINTS: dict[str, str] = {"CALA": "xyz", "VXY": "z", "VXZ": "y", "VYZ": "x", "VZ": "xy", "POIN": ""}
"""Kinds of points and the coordinates that they fix."""
SIGMAS = ("SX", "SY", "SZ")
TURNED = ("BEAR", "SLOPE", "ROLL", "HDEFL")


@dataclass
class Point:
    """A declared point.

    Attributes
    ----------
    place : (3,) float, [m]
        As declared: where it is known, or roughly.
    information : (3, 3) float, [1 / m^2]
        Inverse covariance of what is known of its coordinates; 0 along free ones.
    told : (3,) float, [1 / m]
        `information` times the coordinates that it belongs to.
    """

    place: Floats
    information: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    told: Floats = field(default_factory=lambda: np.zeros(3))

    def add(self, place: Floats, covariance: Floats, axes: Bools) -> None:
        """Learn coordinates (3,) with their covariance (3, 3) along some axes."""
        at = np.ix_(axes, axes)
        information = np.zeros((3, 3))
        information[at] = np.linalg.inv(covariance[at])
        self.information = self.information + information
        self.told = self.told + information @ place

    @property
    def axes(self) -> Axes | None:
        """The coordinates that are known; None for none."""
        known = "".join(axis for axis, weight in zip("xyz", np.diag(self.information), strict=True) if weight > 0)
        return known or None  # type: ignore[return-value]

    @property
    def is_fixed(self) -> bool:
        """Whether an observation can tell nothing more."""
        return bool(np.all(np.diag(self.information) >= 0.5 * FIXED**-2))

    @property
    def known(self) -> tuple[Floats, Floats]:
        """Coordinates (3,) [m], free ones as declared, and covariance (3, 3) [m^2], theirs 1 mm^2."""
        axes = np.diag(self.information) > 0
        at, covariance, place = np.ix_(axes, axes), np.eye(3) * MILLIMETRE**2, self.place.copy()
        covariance[at] = np.linalg.inv(self.information[at])
        place[axes] += covariance[at] @ (self.told - self.information @ self.place)[axes]
        return place, covariance


def point_of(keyword: str, tokens: Sequence[str], file: Path, row: int) -> tuple[str, Point]:
    """A line of a block of points; raises RecordError."""
    name, place = _named_place(tokens, "a point needs a name and three coordinates", file, row)
    point = Point(place)
    axes = np.array([axis in POINTS[keyword] for axis in "xyz"])
    if axes.any():
        point.add(place, np.eye(3) * FIXED**2, axes)
    elif len(tokens) > 4:
        _known_with_sigmas(point, [token.upper() for token in tokens[4:]], file, row)
    return name, point


def observed_point(tokens: Sequence[str], file: Path, row: int) -> tuple[str, Floats, Floats]:
    """A line of OBSXYZ: point, coordinates (3,) [m], covariance (3, 3) [m^2]; raises RecordError."""
    message = "*OBSXYZ needs a point, three coordinates and three standard deviations"
    name, place = _named_place(tokens, message, file, row)
    if len(tokens) < 7:
        raise RecordError(message, file=file, row=row)
    sigma = np.array([number(t, file=file, row=row, column=s) for t, s in zip(tokens[4:7], SIGMAS, strict=True)])
    if not np.all(sigma > 0):
        raise RecordError("a standard deviation of 0", file=file, row=row)
    return name, place, np.diag(sigma * MILLIMETRE) ** 2


def _named_place(tokens: Sequence[str], message: str, file: Path, row: int) -> tuple[str, Floats]:
    name = check_name(tokens[0], "point", file=file, row=row)
    if len(tokens) < 4:
        raise RecordError(message, file=file, row=row)
    values = [number(t, file=file, row=row, column=c, limit=1e8) for t, c in zip(tokens[1:4], "XYZ", strict=True)]
    return name, np.array(values)


def _known_with_sigmas(point: Point, words: list[str], file: Path, row: int) -> None:
    """What follows the coordinates of a *POIN."""
    turned = next((word for word in words if word in TURNED), None)
    if turned is not None:
        raise RecordError(
            f"{turned}: standard deviations in turned axes are not read; give APRICOV", file=file, row=row
        )
    if "APRICOV" in words:
        at = words.index("APRICOV") + 1
        point.add(point.place, _matrix(words[at] if at < len(words) else "", file, row), np.ones(3, dtype=bool))
        return
    stated = {word: words[i + 1] for i, word in enumerate(words[:-1]) if word in SIGMAS}
    sigma = [number(stated[s], file=file, row=row, column=s) * MILLIMETRE if s in stated else np.nan for s in SIGMAS]
    axes = np.isfinite(sigma)
    if axes.any():
        point.add(point.place, np.diag(np.fmax(sigma, FIXED) ** 2), axes)


def _matrix(word: str, file: Path, row: int) -> Floats:
    """The covariance (3, 3) [m^2] that `DIAG(xx,yy,zz)` or `MAT(xx,xy,...,zz)` states."""
    found = re.fullmatch(r"(DIAG|MAT)\(([^()]*)\)", word)
    values = [number(v, file=file, row=row, column="APRICOV") for v in found[2].split(",")] if found else []
    if found and len(values) == (3 if found[1] == "DIAG" else 9):
        matrix = np.diag(values) if found[1] == "DIAG" else np.array(values).reshape(3, 3)
        if np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0) and np.linalg.eigvalsh(matrix)[0] > 0:
            return matrix
    message = "expected DIAG(xx,yy,zz) or MAT(xx,xy,...,zz), a covariance in square metres"
    raise RecordError(message, file=file, row=row, column="APRICOV")
