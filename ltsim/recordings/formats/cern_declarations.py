"""Declarations in files of CERN's LGC: points with the precision of their coordinates, and polar instruments.

The options ``SX``, ``SY``, ``SZ`` at the end of a ``*POIN`` line are standard deviations in mm, 0 for a fixed axis; an
axis without option is free. ``APRICOV DIAG(...)`` or ``MAT(...)`` is a covariance in square metres. An ``*OBSXYZ`` line
observes a point: coordinates, and their standard deviations in mm. Several observations of a point are replaced by
their weighted mean.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import ARCSECOND, CENTESIMAL_SECOND, MILLIMETRE, PPM
from ltsim.recordings.files import SourceLocation, safe_excerpt
from ltsim.recordings.setup import Axes, Instrument, Noise

FIXED_COORDINATE_SIGMA_M = 1e-7
"""Standard deviation [m] that represents a fixed coordinate in the adjustment."""
FIXED_AXES_BY_KEYWORD: dict[str, str] = {"CALA": "xyz", "VXY": "z", "VXZ": "y", "VYZ": "x", "VZ": "xy", "POIN": ""}
"""Axes along which points are fixed, by the keyword (such as ``*CALA``) of the section with their declarations."""
COORDINATE_SIGMA_OPTIONS = ("SX", "SY", "SZ")
"""Options of a point that precede the standard deviations along x, y, z."""
SIGMA_ROTATION_OPTIONS = ("BEAR", "SLOPE", "ROLL", "HDEFL")
"""Options that rotate the axes of a point's standard deviations; a file with such an option is refused."""
OPTIONS_WITH_VALUE = (
    "OBSE",
    "PPM",
    "TH",
    "THSE",
    "TCSE",
    "TRGT",
    "ID",
    "ASE",
    "ZSE",
    "DSE",
    "ACST",
    "IH",
    "IHSE",
    "ICSE",
)
"""Options of LGC that have a value after their name; all other options are flags."""


@dataclass(frozen=True)
class LineWords:
    """Words of one line of an LGC file, and location of the line."""

    words: Sequence[str]
    location: SourceLocation

    def first_words(self, n_words: int, message: str) -> Sequence[str]:
        """First `n_words` words of the line; raises RecordError with `message` if there are fewer."""
        if len(self.words) < n_words:
            raise self.location.error(message)
        return self.words[:n_words]

    def numbers(self, first_word: int, *columns: str, limit: float = 1e12) -> list[float]:
        """Numbers in consecutive words from index `first_word` on; `columns` are the names of these words in errors.

        Raises RecordError if a word is not a decimal number of at most `limit` in magnitude.
        """
        words = zip(self.words[first_word : first_word + len(columns)], columns, strict=True)
        return [self.location.parse_number(word, column, limit=limit) for word, column in words]

    def options(self, first_word: int) -> LineOptions:
        """Options at the end of the line, from the word with index `first_word`; raises RecordError."""
        value_by_option: dict[str, str] = {}
        remaining_words = iter(self.words[first_word:])
        for word in map(str.upper, remaining_words):
            value = next(remaining_words, None) if word in OPTIONS_WITH_VALUE else ""
            if value is None:
                raise self.location.error(f"the option {word} has no value, expected a value after it")
            value_by_option[word] = value
        return LineOptions(value_by_option, self.location)


@dataclass(frozen=True)
class LineOptions:
    """Options at the end of a line of an LGC file: text of each value by name of the option, '' for a flag."""

    values: dict[str, str]
    location: SourceLocation

    def number(self, name: str, default: float) -> float:
        """Value of the option `name` as a number; `default` if the line does not have it. Raises RecordError."""
        return self.location.parse_number(self.values[name], name) if name in self.values else default


@dataclass
class DeclaredPoint:
    """Point declared in an LGC file: coordinates, and sums for the weighted mean of its observed coordinates."""

    declared_coordinates: Floats
    """Coordinates (3,) [m] in the declaration, either known or approximate."""
    inverse_covariance: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    """Sum (3, 3) [1 / m^2] of the inverse covariances of all observations of the point; 0 along axes without
    observation."""
    weighted_coordinate_sum: Floats = field(default_factory=lambda: np.zeros(3))
    """Sum (3,) [1 / m] of the products of inverse covariance and observed coordinates."""

    def add_observation(self, point: Floats, covariance: Floats, axis_mask: Bools | None = None) -> None:
        """Addition of an observation: coordinates `point` (3,) [m] and their covariance (3, 3) [m^2].

        `axis_mask` (3,) is True for the observed axes; by default all.
        """
        block = np.ix_(*[np.ones(3, dtype=bool) if axis_mask is None else axis_mask] * 2)
        weights = np.zeros((3, 3))
        weights[block] = np.linalg.inv(covariance[block])
        self.inverse_covariance = self.inverse_covariance + weights
        self.weighted_coordinate_sum = self.weighted_coordinate_sum + weights @ point

    @property
    def known_axes(self) -> Axes | None:
        """Axes with fixed or observed coordinates, such as "xy"; None if there are none."""
        axes = "".join(axis for axis, weight in zip("xyz", np.diag(self.inverse_covariance), strict=True) if weight > 0)
        return axes or None  # type: ignore[return-value]

    @property
    def is_fixed(self) -> bool:
        """True if the point is fixed along all axes; observations of its coordinates are then ignored."""
        return bool(np.all(np.diag(self.inverse_covariance) >= 0.5 * FIXED_COORDINATE_SIGMA_M**-2))

    @property
    def is_placeholder(self) -> bool:
        """True if the plan coordinates are 0, which stands for unknown coordinates."""
        return not np.any(self.declared_coordinates[:2])

    @property
    def point_and_covariance(self) -> tuple[Floats, Floats]:
        """Weighted mean (3,) [m] of the observed coordinates, and its covariance (3, 3) [m^2].

        A coordinate without observation has the declared value and a variance of 1 mm^2.
        """
        axes = np.diag(self.inverse_covariance) > 0
        block, covariance, point = np.ix_(axes, axes), np.eye(3) * MILLIMETRE**2, self.declared_coordinates.copy()
        covariance[block] = np.linalg.inv(self.inverse_covariance[block])
        point[axes] += (
            covariance[block]
            @ (self.weighted_coordinate_sum - self.inverse_covariance @ self.declared_coordinates)[axes]
        )
        return point, covariance


def parse_point(keyword: str, line_words: LineWords) -> tuple[str, DeclaredPoint]:
    """Name and declaration of the point in a line of a section such as ``*CALA``; raises RecordError.

    `keyword` is the keyword of the section, without asterisk.
    """
    name, declared_coordinates = _name_and_point(line_words, "a point needs a name and three coordinates")
    point = DeclaredPoint(declared_coordinates)
    axes = np.array([axis in FIXED_AXES_BY_KEYWORD[keyword] for axis in "xyz"])
    if axes.any():
        point.add_observation(declared_coordinates, np.eye(3) * FIXED_COORDINATE_SIGMA_M**2, axes)
    else:
        _read_precision(point, [token.upper() for token in line_words.words[4:]], line_words.location)
    return name, point


def parse_observed_point(line_words: LineWords) -> tuple[str, Floats, Floats]:
    """Name, coordinates (3,) [m], covariance (3, 3) [m^2] of the point in an ``*OBSXYZ`` line; raises RecordError."""
    message = "*OBSXYZ needs a point, three coordinates and three standard deviations"
    name, point = _name_and_point(line_words, message)
    line_words.first_words(7, message)
    sigma = np.array(line_words.numbers(4, *COORDINATE_SIGMA_OPTIONS))
    if not np.all(sigma > 0):
        raise line_words.location.error("the line has a standard deviation of 0, expected one above 0")
    return name, point, np.diag(sigma * MILLIMETRE) ** 2


def _name_and_point(line_words: LineWords, message: str) -> tuple[str, Floats]:
    """Name and coordinates (3,) [m] at the beginning of a line; RecordError with `message` if they are missing."""
    name = line_words.location.checked_name(line_words.words[0], "point")
    line_words.first_words(4, message)
    return name, np.array(line_words.numbers(1, "X", "Y", "Z", limit=1e8))


def _read_precision(point: DeclaredPoint, sigma_words: list[str], location: SourceLocation) -> None:
    """Addition of the standard deviations or covariance in `sigma_words` to a point; raises RecordError."""
    rotation_word = next((word for word in sigma_words if word in SIGMA_ROTATION_OPTIONS), None)
    if rotation_word is not None:
        raise location.error(
            f"the axes of standard deviations are rotated ({rotation_word}), which is not supported; use APRICOV"
        )
    if "APRICOV" in sigma_words:
        point.add_observation(
            point.declared_coordinates,
            _parse_matrix("".join(sigma_words[sigma_words.index("APRICOV") + 1 :][:1]), location),
        )
        return
    value_by_option = {
        word: sigma_words[i + 1] for i, word in enumerate(sigma_words[:-1]) if word in COORDINATE_SIGMA_OPTIONS
    }
    sigma = np.array(
        [
            location.parse_number(value_by_option[s], s) * MILLIMETRE if s in value_by_option else np.nan
            for s in COORDINATE_SIGMA_OPTIONS
        ]
    )
    if value_by_option:
        point.add_observation(
            point.declared_coordinates, np.diag(np.fmax(sigma, FIXED_COORDINATE_SIGMA_M) ** 2), np.isfinite(sigma)
        )


def _parse_matrix(word: str, location: SourceLocation) -> Floats:
    """Covariance (3, 3) [m^2] from a word `DIAG(xx,yy,zz)` or `MAT(xx,xy,...,zz)`; raises RecordError."""
    match = re.fullmatch(r"(DIAG|MAT)\(([^()]*)\)", word)
    matrix_entries = [location.parse_number(v, "APRICOV") for v in match[2].split(",")] if match else []
    if match and len(matrix_entries) == (3 if match[1] == "DIAG" else 9):
        matrix = np.diag(matrix_entries) if match[1] == "DIAG" else np.array(matrix_entries).reshape(3, 3)
        if np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0) and np.linalg.eigvalsh(matrix)[0] > 0:
            return matrix
    raise location.error("expected DIAG(xx,yy,zz) or MAT(xx,xy,...,zz), a covariance in square metres", "APRICOV")


@dataclass(frozen=True)
class TargetSigmas:
    """Declared standard deviations of the observations of one kind of target, and height [m] of such targets."""

    azimuth_sigma_cc: float
    zenith_sigma_cc: float
    distance_sigma_mm: float
    """Constant part [mm] of the standard deviation of a distance."""
    distance_sigma_ppm: float
    """Part [ppm] of the standard deviation of a distance that is proportional to the distance."""
    target_height: float

    def sigma_of(self, kind: str, options: LineOptions, value: float) -> float:
        """Standard deviation [m, rad] of an observation, from the options of its line or else from the kind of target.

        `kind` is azimuth, elevation or distance; `value` is the distance [m]. Raises RecordError if the result is 0.
        """
        option, default_sigma = {
            "azimuth": ("ASE", self.azimuth_sigma_cc),
            "elevation": ("ZSE", self.zenith_sigma_cc),
            "distance": ("DSE", self.distance_sigma_mm),
        }[kind]
        declared = options.number(option, options.number("OBSE", default_sigma))
        sigma = declared * CENTESIMAL_SECOND
        if kind == "distance":
            sigma = declared * MILLIMETRE + options.number("PPM", self.distance_sigma_ppm) * PPM * value
        if not sigma > 0:
            raise options.location.error("the standard deviation is 0, expected one above 0", kind)
        return sigma


@dataclass
class PolarInstrument:
    """Polar instrument in an LGC file: name of its default kind of target, its height [m], kinds of target by name."""

    default_target_kind: str
    height: float
    target_kinds: dict[str, TargetSigmas] = field(default_factory=dict)

    def add_target(self, line_words: LineWords) -> str:
        """Addition of the kind of target that a line declares; the result is a note for the user.

        The note says that a distance correction is not applied; it is '' without such a correction. Raises RecordError.
        """
        fields = "its name and the standard deviations of azimuth, elevation, distance (constant and ppm)"
        name = line_words.first_words(5, f"a target needs {fields}")[0]
        height = line_words.numbers(9, "height")[0] if len(line_words.words) > 9 else 0.0
        correction = line_words.numbers(6, "correction")[0] if len(line_words.words) > 6 else 0.0
        azimuth, elevation, distance, ppm = line_words.numbers(1, "sigma", "sigma", "sigma", "sigma")
        self.target_kinds[name] = TargetSigmas(azimuth, elevation, distance, ppm, height)
        return (
            f"the distance correction of {correction:g} m of target {safe_excerpt(name)} is not applied"
            if correction
            else ""
        )

    def instrument(self, name: str) -> Instrument:
        """Instrument with this name and its noise; a name such as AT402.392506 contains model and serial number."""
        match = re.fullmatch(r"([A-Z]+\d+)[._](\d{4,})", name)
        model, serial = match.groups() if match else (None, None)
        return Instrument(noise=self._noise(), corrected=True, model=model, serial=serial)

    def _noise(self) -> Noise:
        """Noise from the standard deviations of the default kind of target, or else of the first declared kind."""
        sigmas = self.target_kinds.get(self.default_target_kind) or next(iter(self.target_kinds.values()), None)
        if sigmas is None:
            return Noise()
        return Noise(
            distance_mm=max(sigmas.distance_sigma_mm, 1e-6),
            distance_ppm=sigmas.distance_sigma_ppm,
            azimuth_arcsec=max(sigmas.azimuth_sigma_cc * CENTESIMAL_SECOND / ARCSECOND, 1e-6),
            elevation_arcsec=max(sigmas.zenith_sigma_cc * CENTESIMAL_SECOND / ARCSECOND, 1e-6),
        )
