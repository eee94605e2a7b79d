"""Format: input files of CERN's LGC (``.lgc``, ``.lgc2``).

The reader supports points (``*CALA``, ``*POIN``, ``*VXY`` and similar, ``*PDOR``), observed coordinates (``*OBSXYZ``),
polar instruments with the standard deviations for their targets, set-ups (``*TSTN``, ``*V0``), observations
(``*PLR3D``, ``*ANGL``, ``*ZEND``, ``*DIST``, ``*DHOR``), free rotation (``ROT3D``), and lines switched off with ``%``.
Other observations, and those in separate frames (``*FRAME``), are skipped and reported in a note. Angles are clockwise,
in gon; coordinates and distances are in metres.

In a curved reference system (``*RS2K`` and others) the third coordinate is a height. The reader converts it to the z
coordinate over a plane that is tangent in the middle of the network. Each levelled set-up gets the direction of the
plumb line at its position.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.limits import MAX_LGC_LINES
from ltsim.core.notation import names_text
from ltsim.core.units import EARTH_RADIUS, GON, MILLIMETRE
from ltsim.recordings.files import SourceLocation, read_lines, safe_excerpt, single_line_title
from ltsim.recordings.formats.cern_declarations import (
    FIXED_AXES_BY_KEYWORD,
    FIXED_COORDINATE_SIGMA_M,
    DeclaredPoint,
    LineWords,
    PolarInstrument,
    parse_observed_point,
    parse_point,
)
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.pointings import (
    NOT_MEASURED,
    ObservationKind,
    SingleObservation,
    numbered_name,
    pointings_from_observations,
    recording_from_pointings,
    separate_constant_heights,
)
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import EXACT_LEVELLING_SIGMA_ARCSEC, Setup, Station, Target, Vector

OBSERVATION_KEYWORDS: dict[str, tuple[ObservationKind, ...]] = {
    "PLR3D": ("azimuth", "elevation", "distance"),
    "ANGL": ("azimuth",),
    "ZEND": ("elevation",),
    "DIST": ("distance",),
    "DHOR": ("distance",),
}
"""Observables in a line of observations, by the keyword of its section, such as ``*PLR3D``."""
CURVED_REFERENCE_KEYWORDS = ("RS2K", "LEP", "SPHE")
"""Keywords of reference systems in which the third coordinate is a height above a curved surface."""
KEYWORDS_WITHOUT_OBSERVATIONS = (
    *("TITR", "OLOC", "HIST", "PREC", "PUNC", "FAUT", "JSON", "APRI", "DEFA", "FMTP", "NODUP", "SOBS", "EREL"),
    *("COVAR", "CONSI", "LM", "TOL", "NOSPC", "PRES", "CHABA", "INSTR", "POLAR", "PDOR", "TSTN", "V0", "END"),
)
"""Keywords of sections without observations, which are skipped without a note."""


@dataclass(frozen=True)
class _SetUp:
    """Set-up over a point: instrument, its height [m], default kind of target, constant added to directions [rad]."""

    point: str
    instrument: str
    height: float
    levelled: bool
    default_target_kind: str
    direction_constant: float = 0.0


@dataclass
class _LgcContent:
    """Content of an LGC file, which the reader completes line by line."""

    path: Path
    title_words: list[str] = field(default_factory=list)
    curved_reference_keyword: str = ""
    points: dict[str, DeclaredPoint] = field(default_factory=dict)
    frames: list[str] = field(default_factory=list)
    points_observed_in_frames: list[str] = field(default_factory=list)
    observed_points: list[tuple[str, Floats, Floats]] = field(default_factory=list)
    orientation_points: dict[str, None] = field(default_factory=dict)
    """Names, in the order of the file, of the points that orient the frame (``*PDOR``)."""
    instruments: dict[str, PolarInstrument] = field(default_factory=dict)
    setups: dict[str, _SetUp] = field(default_factory=dict)
    n_setups_by_point: Counter[str] = field(default_factory=Counter)
    observations: list[SingleObservation] = field(default_factory=list)
    n_skipped_by_keyword: dict[str, int] = field(default_factory=dict)
    n_switched_off_lines: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def station(self) -> str:
        """Name of the latest set-up; '' before the first one."""
        return next(reversed(self.setups), "")

    def add_setup(self, setup: _SetUp) -> None:
        """Addition of a set-up; a further set-up over one point gets a number."""
        self.setups[numbered_name(setup.point, self.n_setups_by_point[setup.point])] = setup
        self.n_setups_by_point[setup.point] += 1


def recognises(path: Path, file_beginning: str) -> bool:
    """True if a file begins like an LGC file."""
    return re.search(r"^[^\S\n]*+\*(TITR|RS2K|OLOC|INSTR|CALA|POIN)\b", file_beginning, re.MULTILINE) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording of an LGC input file.

    Raises RecordError for a malformed line, an instrument or target that is not declared, or a file without ``*END``.
    """
    lgc = _LgcContent(path)
    keyword, in_frame = "", False
    for words in _words_by_line(lgc):
        first = words.words[0]
        if first.startswith("*"):
            keyword = first[1:].upper()
            in_frame = (in_frame or keyword == "FRAME") and keyword != "ENDFRAME"
            if keyword == "FRAME":
                lgc.frames.append(" ".join(words.words[1:2]))
            if not in_frame:
                _begin_block(keyword, LineWords(words.words[1:], words.location), lgc)
        elif in_frame and keyword == "OBSXYZ":
            lgc.points_observed_in_frames.append(first)
        elif in_frame or not _process_line(keyword, words, lgc):
            lgc.n_skipped_by_keyword[keyword] = lgc.n_skipped_by_keyword.get(keyword, 0) + 1
        if keyword == "END":
            break
    if keyword != "END" or in_frame:
        missing = "*ENDFRAME" if in_frame else "*END"
        raise RecordError(f"the file ends without {missing} and is incomplete", file=path)
    return _make_recording(lgc)


def _words_by_line(lgc: _LgcContent) -> Iterator[LineWords]:
    """Words of each line that is not empty, without comments after % and $."""
    for i, line in enumerate(read_lines(lgc.path, replaces_undecodable=True, max_lines=MAX_LGC_LINES)):
        text = line.partition("%")[0].partition("$")[0]
        if line.lstrip().startswith("%"):
            lgc.n_switched_off_lines += len(line.split()) > 2 and re.search(r"\d\.\d{3}", line[:150]) is not None
        elif text.strip():
            yield LineWords(text.split(), SourceLocation(lgc.path, i + 1))


def _begin_block(keyword: str, line_words: LineWords, lgc: _LgcContent) -> None:
    if keyword in CURVED_REFERENCE_KEYWORDS:
        lgc.curved_reference_keyword = keyword
    elif keyword == "POLAR":
        name, default, _ = line_words.first_words(3, "*POLAR needs an instrument, its default target and a height")
        lgc.instruments[line_words.location.checked_name(name, "instrument")] = PolarInstrument(
            default, line_words.numbers(2, "height")[0]
        )
    elif keyword == "TSTN":
        _begin_setup(line_words, lgc)
    elif keyword == "V0":
        _begin_direction_set(line_words, lgc)
    elif keyword not in (
        *KEYWORDS_WITHOUT_OBSERVATIONS,
        *FIXED_AXES_BY_KEYWORD,
        *OBSERVATION_KEYWORDS,
        "OBSXYZ",
        "FRAME",
        "ENDFRAME",
    ):
        lgc.n_skipped_by_keyword.setdefault(keyword, 0)


def _begin_setup(line_words: LineWords, lgc: _LgcContent) -> None:
    instrument = "".join(line_words.words[1:2])
    if instrument not in lgc.instruments:
        given = safe_excerpt(instrument) or "nothing"
        raise line_words.location.error(f"*TSTN names {given}, expected an instrument that *POLAR declares")
    point = line_words.location.checked_name(line_words.words[0], "station")
    if point not in lgc.points:
        raise line_words.location.error(f"the set-up is on {point}, which no block of points declares")
    options, polar = line_words.options(2), lgc.instruments[instrument]
    height = options.number("IH", polar.height if "IHFIX" in options.values else 0.0)
    default = options.values.get("TRGT", polar.default_target_kind)
    lgc.add_setup(_SetUp(point, instrument, height, "ROT3D" not in options.values, default))


def _begin_direction_set(line_words: LineWords, lgc: _LgcContent) -> None:
    """Start of a set of directions (``*V0``) with a common orientation of the horizontal circle.

    The first set after ``*TSTN`` belongs to the set-up of that line. Each further set adds a set-up over this point.
    """
    if not lgc.setups:
        raise line_words.location.error("*V0 has no set-up (*TSTN) before it")
    options, name = line_words.options(0), lgc.station
    setup = lgc.setups[name]
    default = options.values.get("TRGT", setup.default_target_kind)
    setup = replace(setup, direction_constant=options.number("ACST", 0.0) * GON, default_target_kind=default)
    if lgc.observations and lgc.observations[-1].station == name:
        lgc.add_setup(setup)
    else:
        lgc.setups[name] = setup


def _process_line(keyword: str, line_words: LineWords, lgc: _LgcContent) -> bool:
    """Addition of the content of a line to `lgc`; False if its section (`keyword`) is not supported."""
    if keyword in ("TITR", ""):
        lgc.title_words += line_words.words
    elif keyword in FIXED_AXES_BY_KEYWORD:
        name, point = parse_point(keyword, line_words)
        if name in lgc.points:
            raise line_words.location.error(f"the point {name} is declared twice")
        lgc.points[name] = point
    elif keyword == "OBSXYZ" and not lgc.curved_reference_keyword:
        lgc.observed_points.append(parse_observed_point(line_words))
    elif keyword == "PDOR":
        lgc.orientation_points[line_words.words[0]] = None
    elif keyword == "POLAR":
        lgc.notes += filter(None, [lgc.instruments[next(reversed(lgc.instruments))].add_target(line_words)])
    elif keyword in OBSERVATION_KEYWORDS:
        _add_observation(keyword, line_words, lgc)
    else:
        return keyword in KEYWORDS_WITHOUT_OBSERVATIONS
    return True


def _add_observation(keyword: str, line_words: LineWords, lgc: _LgcContent) -> None:
    kinds, where = OBSERVATION_KEYWORDS[keyword], line_words.location
    if not lgc.setups:
        raise where.error(f"*{keyword} has no set-up (*TSTN) before it")
    line_words.first_words(1 + len(kinds), f"*{keyword} needs a point and {len(kinds)} values")
    setup = lgc.setups[lgc.station]
    target = where.checked_name(line_words.words[0], "target")
    if target not in lgc.points:
        raise where.error(f"the point {target} is in no block of points")
    options = line_words.options(1 + len(kinds))
    kind_of_target, sigmas_by_target = (
        options.values.get("TRGT", setup.default_target_kind),
        lgc.instruments[setup.instrument].target_kinds,
    )
    if kind_of_target not in sigmas_by_target:
        raise where.error(
            f"the target {safe_excerpt(kind_of_target)} is not declared with instrument {setup.instrument}"
        )
    height = options.number("TH", sigmas_by_target[kind_of_target].target_height)
    for kind, value in zip(kinds, line_words.numbers(1, *kinds, limit=1e6), strict=True):
        reading, sigma = (
            _reading_in_si(kind, value, setup, where),
            sigmas_by_target[kind_of_target].sigma_of(kind, options, value),
        )
        heights = setup.height, NOT_MEASURED if kind == "azimuth" else height, keyword == "DHOR"
        lgc.observations.append(SingleObservation(kind, lgc.station, target, reading, sigma, *heights, where.row or 0))


def _reading_in_si(kind: ObservationKind, value: float, setup: _SetUp, location: SourceLocation) -> float:
    """Distance [m], counter-clockwise azimuth [rad] or elevation [rad], as `kind` says, from a `value` in the file.

    Raises RecordError for a zenith angle beyond 200 gon and for a distance that is not above 0.
    """
    if kind == "azimuth":
        return float(np.mod(-value * GON - setup.direction_constant, 2 * np.pi))
    if kind == "elevation":
        if not 0 <= value <= 200:
            raise location.error(
                f"found a zenith angle of {value:g} gon, expected 0 to 200 gon; reduce readings of face 2 to face 1"
            )
        return float(np.pi / 2 - value * GON)
    if value <= 0:
        raise location.error(f"found a distance of {value:g}, expected one above 0")
    return value


def _make_recording(lgc: _LgcContent) -> Recording:
    pointings, instrument_heights, target_heights = separate_constant_heights(
        pointings_from_observations(lgc.observations, lgc.path.name)
    )
    if not pointings:
        raise RecordError("the file contains no polar observations", file=lgc.path)
    targets = dict.fromkeys(p.target for p in pointings)
    _add_observed_coordinates(lgc)
    occupied_marks = [s.point for s in lgc.setups.values() if lgc.points[s.point].known_axes or s.point in targets]
    plane = _TangentPlane.from_points(
        [lgc.points[name] for name in {*targets, *(s.point for s in lgc.setups.values())}],
        lgc.curved_reference_keyword,
    )
    setup = Setup(
        title=single_line_title(" ".join(lgc.title_words)),
        instruments={name: polar.instrument(name) for name, polar in lgc.instruments.items()},
        stations={
            name: Station(
                **plane.station_settings(lgc.points[s.point], levelled=s.levelled),
                instrument=s.instrument,
                instrument_height_mm=instrument_heights.get(name, 0.0),
                over=s.point if s.point in occupied_marks else None,
            )
            for name, s in lgc.setups.items()
        },
        targets={
            name: Target(
                **plane.target_settings(lgc.points[name]),
                datum=name in lgc.orientation_points,
                height_mm=target_heights.get(name, 0.0),
            )
            for name in dict.fromkeys([*targets, *occupied_marks])
        },
    )
    return recording_from_pointings(
        pointings, setup, notes=list(dict.fromkeys([*lgc.notes, *_notes(lgc)])), file=lgc.path
    )


def _add_observed_coordinates(lgc: _LgcContent) -> None:
    """Addition of the observations in ``*OBSXYZ`` sections to the points, except fixed ones; raises RecordError."""
    for name, point, covariance in lgc.observed_points:
        if name not in lgc.points:
            raise RecordError(f"*OBSXYZ observes {name}, which is in no block of points", file=lgc.path)
        if lgc.points[name].is_fixed:
            lgc.notes.append(f"the coordinates of {name} in *OBSXYZ are not used, because the point is fixed")
        else:
            lgc.points[name].add_observation(point, covariance)


@dataclass(frozen=True)
class _TangentPlane:
    """Horizontal plane at the plan coordinates `centre` (2,) [m], tangent to the reference surface of heights there.

    `is_curved` is False if the reference surface is a plane.
    """

    centre: Floats
    is_curved: bool

    @classmethod
    def from_points(cls, points: list[DeclaredPoint], earth_model: str) -> _TangentPlane:
        """Tangent plane at the median of points with known plan coordinates; `earth_model` is '' without curvature."""
        plan_points = [point.declared_coordinates[:2] for point in points if not point.is_placeholder]
        return cls(np.median(plan_points, axis=0) if plan_points else np.zeros(2), bool(earth_model))

    def plane_coordinates(self, point: Floats) -> Vector:
        """Coordinates [mm] with z over the plane, from `point` (3,) [m] with z over the reference surface."""
        x, y, height = point.tolist()
        drop = float(np.sum((point[:2] - self.centre) ** 2)) / (2 * EARTH_RADIUS) if self.is_curved else 0.0
        return round(x * 1e3, 6), round(y * 1e3, 6), round((height - drop) * 1e3, 6)

    def station_settings(self, point: DeclaredPoint, *, levelled: bool) -> dict[str, Any]:
        """Keys and values in `setup.toml` for a set-up over a point: position, levelling, plumb line."""
        keys: dict[str, Any] = (
            {} if point.is_placeholder else {"position_mm": self.plane_coordinates(point.declared_coordinates)}
        )
        if levelled:
            keys |= {"levelled": True, "levelling_sigma_arcsec": EXACT_LEVELLING_SIGMA_ARCSEC}
        if levelled and self.is_curved and keys.get("position_mm"):
            x, y = ((point.declared_coordinates[:2] - self.centre) / EARTH_RADIUS).round(12).tolist()
            keys["vertical"] = (x, y, 1.0)
        return keys

    def target_settings(self, point: DeclaredPoint) -> dict[str, Any]:
        """Keys and values in `setup.toml` for a target: coordinates known along some axes, approximate along others."""
        axes = point.known_axes
        if axes is None:
            return (
                {} if point.is_placeholder else {"approximate_mm": self.plane_coordinates(point.declared_coordinates)}
            )
        coordinates, covariance = point.point_and_covariance
        keys: dict[str, Any] = {"known_mm": self.plane_coordinates(coordinates), "known_axes": axes}
        keys["known_sigma_mm"] = FIXED_COORDINATE_SIGMA_M / MILLIMETRE
        if not all(
            abs(covariance[k, k] / FIXED_COORDINATE_SIGMA_M**2 - 1.0) < 1e-6 for k in range(3) if "xyz"[k] in axes
        ):
            keys["known_covariance_mm2"] = tuple((covariance[np.triu_indices(3)] / MILLIMETRE**2).tolist())
        return keys if axes == "xyz" else keys | {"approximate_mm": self.plane_coordinates(point.declared_coordinates)}


def _notes(lgc: _LgcContent) -> Iterator[str]:
    if lgc.n_switched_off_lines:
        yield f"{lgc.n_switched_off_lines} lines are switched off with % and are not used"
    for keyword, count in lgc.n_skipped_by_keyword.items():
        axes_reason = (
            f"contains coordinates of a system whose third axis is not a height (*{lgc.curved_reference_keyword})"
        )
        reason = axes_reason if keyword == "OBSXYZ" else "is not supported"
        yield f"*{safe_excerpt(keyword)} {reason}: {count} lines are skipped"
    if lgc.points_observed_in_frames:
        frames = names_text([*map(safe_excerpt, lgc.frames)])
        sentence = f"*OBSXYZ observes {len(lgc.points_observed_in_frames)} points in a separate frame ({frames})"
        if all(name in lgc.points and lgc.points[name].is_fixed for name in lgc.points_observed_in_frames):
            yield f"{sentence}: they are not used, because all of them are fixed"
        else:
            yield f"{sentence}: they are skipped, because ltsim does not adjust the pose of this frame"
    if lgc.curved_reference_keyword:
        sphere = "heights refer to a curved surface, for which ltsim uses a sphere: plumb lines differ between stations"
        yield f"*{lgc.curved_reference_keyword}: {sphere}"
    for name in lgc.orientation_points:
        yield f"the approximate coordinates of {safe_excerpt(name)} orient the frame (*PDOR)"
