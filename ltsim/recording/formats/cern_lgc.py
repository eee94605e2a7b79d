"""Input files of CERN's LGC (``.lgc``, ``.lgc2``).

Understood are points (``*CALA``, ``*POIN``, ``*VXY`` and its kin, ``*PDOR``) and what observes them (``*OBSXYZ``),
polar instruments with the sigmas of their targets, set-ups (``*TSTN``, ``*V0``), observations (``*PLR3D``, ``*ANGL``,
``*ZEND``, ``*DIST``, ``*DHOR``), free rotation (``ROT3D``) and lines switched off with ``%``. Other observations are
named in a note and skipped, and so are those in frames of their own (``*FRAME``).
Angles count clockwise, in gon; coordinates and distances are in metres.

In a curved reference (``*RS2K`` and others) the third coordinate is a height. It is turned into the z of a plane that
touches the network in its middle, and every levelled set-up gets the direction of plumb that belongs to its place.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.recording.build import NAN, recording_of
from ltsim.recording.conventions import NO_HINTS, Hints
from ltsim.recording.files import MAX_TEXT, check_name, number, read_lines, shown
from ltsim.recording.formats.cern_instruments import (
    Polar,
    add_target,
    instrument_of,
    option,
    options_of,
    sigma_of,
)
from ltsim.recording.formats.cern_points import FIXED, POINTS, Point, observed_point, point_of
from ltsim.recording.merge import Kind, Merged, Observed, merged
from ltsim.recording.recording import Recording
from ltsim.recording.setup import EXACT_LEVEL_ARCSEC, Setup, Station, Target, Vector
from ltsim.units import GON, MILLIMETRE

EARTH = 6_371_000.0
OBSERVATIONS: dict[str, tuple[Kind, ...]] = {
    "PLR3D": ("azimuth", "elevation", "distance"),
    "ANGL": ("azimuth",),
    "ZEND": ("elevation",),
    "DIST": ("distance",),
    "DHOR": ("distance",),
}
CURVED = ("RS2K", "LEP", "SPHE")
OPTIONS = (
    *("TITR", "OLOC", "HIST", "PREC", "PUNC", "FAUT", "JSON", "APRI", "DEFA", "FMTP", "NODUP", "SOBS", "EREL"),
    *("COVAR", "CONSI", "LM", "TOL", "NOSPC", "PRES", "CHABA", "INSTR", "POLAR", "PDOR", "TSTN", "V0", "END"),
)


@dataclass
class _SetUp:
    point: str
    instrument: str
    height: float
    levelled: bool
    default: str
    constant: float = 0.0


@dataclass
class _File:
    """What is gathered while reading line by line."""

    path: Path
    title: list[str] = field(default_factory=list)
    curved: str = ""
    points: dict[str, Point] = field(default_factory=dict)
    frames: list[str] = field(default_factory=list)
    framed: list[str] = field(default_factory=list)
    placed: list[tuple[str, Floats, Floats]] = field(default_factory=list)
    orientation: list[str] = field(default_factory=list)
    polar: dict[str, Polar] = field(default_factory=dict)
    setups: dict[str, _SetUp] = field(default_factory=dict)
    station: str = ""
    observed: list[Observed] = field(default_factory=list)
    skipped: dict[str, int] = field(default_factory=dict)
    switched_off: int = 0
    notes: list[str] = field(default_factory=list)


def recognises(path: Path, head: str) -> bool:
    """Whether it begins like an LGC file."""
    return re.search(r"^\s*\*(TITR|RS2K|OLOC|INSTR|CALA|POIN)\b", head, re.MULTILINE) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Read an LGC input file.

    Raises
    ------
    RecordError
        For a malformed line, an instrument or target that is not declared, or a file without ``*END``.
    """
    file = _File(path)
    keyword, last, in_frame = "", "", False
    for row, tokens in _lines(file):
        if tokens[0].startswith("*"):
            keyword = tokens[0][1:].upper()
            last = keyword
            in_frame = (in_frame or keyword == "FRAME") and keyword != "ENDFRAME"
            if keyword == "FRAME":
                file.frames.append(" ".join(tokens[1:2]))
            if not in_frame:
                _begin(keyword, tokens[1:], file, row)
        elif in_frame and keyword == "OBSXYZ":
            file.framed.append(tokens[0])
        elif in_frame or not _line(keyword, tokens, file, row):
            file.skipped[keyword] = file.skipped.get(keyword, 0) + 1
        if keyword == "END":
            break
    if last != "END" or in_frame:
        missing = "*ENDFRAME" if in_frame else "*END"
        raise RecordError(f"the file ends without {missing}: it was cut", file=path)
    return _finished(file)


def _lines(file: _File) -> Iterator[tuple[int, list[str]]]:
    """Line number and words of every line that says something; comments after % and $ are dropped."""
    for i, line in enumerate(read_lines(file.path, liberal=True)):
        text = line.partition("%")[0].partition("$")[0]
        if line.lstrip().startswith("%"):
            file.switched_off += len(line.split()) > 2 and re.search(r"\d\.\d{3}", line[:150]) is not None
        elif text.strip():
            yield i + 1, text.split()


def _begin(keyword: str, rest: list[str], file: _File, row: int) -> None:
    """A keyword with what stands on its line."""
    if keyword in CURVED:
        file.curved = keyword
    elif keyword == "POLAR":
        if len(rest) < 3:
            raise RecordError("*POLAR needs an instrument, its default target and a height", file=file.path, row=row)
        name = check_name(rest[0], "instrument", file=file.path, row=row)
        file.polar[name] = Polar(rest[1], number(rest[2], file=file.path, row=row, column="height"))
    elif keyword == "TSTN":
        _begin_setup(rest, file, row)
    elif keyword == "V0":
        _begin_set(rest, file, row)
    elif keyword not in (*OPTIONS, *POINTS, *OBSERVATIONS, "OBSXYZ", "FRAME", "ENDFRAME"):
        file.skipped.setdefault(keyword, 0)


def _begin_setup(rest: list[str], file: _File, row: int) -> None:
    if len(rest) < 2 or rest[1] not in file.polar:
        found = shown(rest[1]) if len(rest) > 1 else "nothing"
        raise RecordError(f"*TSTN names {found}, expected an instrument declared as *POLAR", file=file.path, row=row)
    point = check_name(rest[0], "station", file=file.path, row=row)
    if point not in file.points:
        raise RecordError(f"the set-up stands on {point}, which no block of points declares", file=file.path, row=row)
    options = options_of(rest[2:], file.path, row)
    polar = file.polar[rest[1]]
    height = option(options, "IH", polar.height if "IHFIX" in options else 0.0, file.path, row)
    file.station = point
    default = options.get("TRGT", polar.default)
    file.setups[_free_name(point, file)] = _SetUp(point, rest[1], height, "ROT3D" not in options, default)
    file.station = next(reversed(file.setups))


def _begin_set(rest: list[str], file: _File, row: int) -> None:
    """An orientation: the first of a set-up is its own, a further one makes a further set-up on the same point."""
    if not file.station:
        raise RecordError("*V0 without a set-up (*TSTN) before it", file=file.path, row=row)
    options = options_of(rest, file.path, row)
    setup = file.setups[file.station]
    constant = option(options, "ACST", 0.0, file.path, row) * GON
    if any(o.station == file.station for o in file.observed):
        setup = _SetUp(setup.point, setup.instrument, setup.height, setup.levelled, setup.default)
        file.station = _free_name(setup.point, file)
        file.setups[file.station] = setup
    setup.constant = constant
    setup.default = options.get("TRGT", setup.default)


def _free_name(point: str, file: _File) -> str:
    count = sum(s.point == point for s in file.setups.values())
    return point if not count else f"{point}#{count + 1}"


def _line(keyword: str, tokens: list[str], file: _File, row: int) -> bool:
    """A line of the current block; False where the block is of no use here."""
    if keyword in ("TITR", ""):
        file.title.append(" ".join(tokens))
    elif keyword in POINTS:
        name, point = point_of(keyword, tokens, file.path, row)
        if name in file.points:
            raise RecordError(f"the point {name} is declared twice", file=file.path, row=row)
        file.points[name] = point
    elif keyword == "OBSXYZ":
        if file.curved:
            return False
        file.placed.append(observed_point(tokens, file.path, row))
    elif keyword == "PDOR":
        file.orientation.append(tokens[0])
    elif keyword == "POLAR":
        file.notes += add_target(file.polar[next(reversed(file.polar))], tokens, file.path, row)
    elif keyword in OBSERVATIONS:
        _observation(keyword, tokens, file, row)
    else:
        return keyword in OPTIONS
    return True


def _observation(keyword: str, tokens: list[str], file: _File, row: int) -> None:
    """One observed point: its values, sigmas and heights."""
    kinds = OBSERVATIONS[keyword]
    if not file.station:
        raise RecordError(f"*{keyword} without a set-up (*TSTN) before it", file=file.path, row=row)
    if len(tokens) < 1 + len(kinds):
        raise RecordError(f"*{keyword} needs a point and {len(kinds)} values", file=file.path, row=row)
    setup = file.setups[file.station]
    target = check_name(tokens[0], "target", file=file.path, row=row)
    if target not in file.points:
        raise RecordError(f"the point {target} is in no block of points", file=file.path, row=row)
    options = options_of(tokens[1 + len(kinds) :], file.path, row)
    used = options.get("TRGT", setup.default)
    declared = file.polar[setup.instrument].targets
    if used not in declared:
        message = f"the target {shown(used)} is not declared with instrument {setup.instrument}"
        raise RecordError(message, file=file.path, row=row)
    height = option(options, "TH", declared[used].height, file.path, row)
    for kind, text in zip(kinds, tokens[1:], strict=False):
        value = number(text, file=file.path, row=row, column=kind, limit=1e6)
        sigma = sigma_of(kind, declared[used], options, value, file.path, row)
        si = _si(kind, value, setup, file, row)
        at = (setup.height, NAN if kind == "azimuth" else height)
        flat = keyword == "DHOR"
        file.observed.append(Observed(kind, file.station, target, si, sigma, *at, horizontal=flat, line=row))


def _si(kind: Kind, value: float, setup: _SetUp, file: _File, row: int) -> float:
    """Reading [m, rad]: azimuth counter-clockwise, elevation instead of the zenith angle."""
    if kind == "azimuth":
        return float(np.mod(-value * GON - setup.constant, 2 * np.pi))
    if kind == "elevation":
        if not 0 <= value <= 200:
            message = f"found a zenith angle of {value:g}, expected 0 to 200 gon (both faces reduced to one)"
            raise RecordError(message, file=file.path, row=row)
        return float(np.pi / 2 - value * GON)
    if value <= 0:
        raise RecordError(f"found a distance of {value:g}, expected one above 0", file=file.path, row=row)
    return value


def _finished(file: _File) -> Recording:
    together = merged(file.observed, file.path.name)
    if not together.pointings:
        raise RecordError("holds no polar observations", file=file.path)
    targets = dict.fromkeys(p.target for p in together.pointings)
    _learn(file)
    marks = [s.point for s in file.setups.values() if file.points[s.point].axes or s.point in targets]
    used = dict.fromkeys([*targets, *marks, *(s.point for s in file.setups.values())])
    middle = _middle(file, list(used))
    setup = Setup(
        title=_title(file),
        instruments={name: instrument_of(name, polar) for name, polar in file.polar.items()},
        stations={name: _station(name, s, file, middle, marks, together) for name, s in file.setups.items()},
        targets={name: _target(name, file, middle, together) for name in dict.fromkeys([*targets, *marks])},
    )
    _say(file)
    return recording_of(together.pointings, setup, notes=list(dict.fromkeys(file.notes)), file=file.path)


def _learn(file: _File) -> None:
    """What observed coordinates say of the points that are not fixed already."""
    for name, place, covariance in file.placed:
        if name not in file.points:
            raise RecordError(f"*OBSXYZ observes {name}, which is in no block of points", file=file.path)
        if file.points[name].is_fixed:
            file.notes.append(f"*OBSXYZ of {name}: the point is fixed, its observed coordinates tell nothing")
        else:
            file.points[name].add(place, covariance, np.ones(3, dtype=bool))


def _middle(file: _File, names: list[str]) -> Floats:
    """Where the network lies in plan (2,) [m]; points at 0, 0 are place-holders."""
    plan = np.array([file.points[name].place[:2] for name in names])
    placed = plan[np.any(plan != 0, axis=1)]
    return np.asarray(np.median(placed, axis=0)) if len(placed) else np.zeros(2)


def _title(file: _File) -> str:
    text = " ".join(" ".join(file.title).split())[:MAX_TEXT]
    return "".join(c for c in text if c.isprintable() and c not in "<>")


def _say(file: _File) -> None:
    if file.switched_off:
        file.notes.append(f"{file.switched_off} lines are switched off with % and left out")
    for keyword, count in file.skipped.items():
        curved = f"observes coordinates in the axes of *{file.curved}, not in those of its heights,"
        why = curved if keyword == "OBSXYZ" else "is not understood here"
        file.notes.append(f"*{shown(keyword)} {why} and skipped ({count} lines)")
    if file.framed:
        file.notes.append(_framed(file))
    if file.curved:
        sphere = "heights refer to a curved surface: a sphere is taken for it, plumb lines differ by place"
        file.notes.append(f"*{file.curved}: {sphere}")
    for name in file.orientation:
        file.notes.append(f"*PDOR: the frame is oriented by the approximate coordinates of {shown(name)}")


def _framed(file: _File) -> str:
    """What is said of coordinates observed in frames of their own."""
    count, frames = len(file.framed), ", ".join(map(shown, file.frames))
    said = f"*OBSXYZ observes {count} points in a frame of its own ({frames})"
    if all(name in file.points and file.points[name].is_fixed for name in file.framed):
        return f"{said}; all of them are fixed, so this tells where that frame lies and nothing of the network"
    return f"{said}, whose place is not adjusted here; they are skipped"


def _local(place: Floats, file: _File, middle: Floats) -> Vector:
    """Coordinates [mm] in the plane that touches the reference in the middle of the network."""
    x, y, height = place.tolist()
    drop = ((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * EARTH) if file.curved else 0.0
    return round(x * 1e3, 6), round(y * 1e3, 6), round((height - drop) * 1e3, 6)


def _is_placeholder(name: str, file: _File) -> bool:
    return not np.any(file.points[name].place[:2])


def _station(name: str, setup: _SetUp, file: _File, middle: Floats, marks: list[str], together: Merged) -> Station:
    vertical: Vector | None = None
    if file.curved and setup.levelled and not _is_placeholder(setup.point, file):
        x, y = ((file.points[setup.point].place[:2] - middle) / EARTH).round(12).tolist()
        vertical = (x, y, 1.0)
    rough = None if _is_placeholder(setup.point, file) else _local(file.points[setup.point].place, file, middle)
    return Station(
        position_mm=rough,
        levelled=setup.levelled,
        levelling_sigma_arcsec=EXACT_LEVEL_ARCSEC if setup.levelled else Station().levelling_sigma_arcsec,
        instrument=setup.instrument,
        instrument_height_mm=together.instrument_heights.get(name, 0.0),
        over=setup.point if setup.point in marks else None,
        vertical=vertical,
    )


def _target(name: str, file: _File, middle: Floats, together: Merged) -> Target:
    point = file.points[name]
    axes = point.axes
    rough = None if _is_placeholder(name, file) and not axes else _local(point.place, file, middle)
    known: dict[str, Any] = {}
    if axes:
        place, covariance = point.known
        spread = covariance[np.triu_indices(3)] / MILLIMETRE**2
        known = {"known_mm": _local(place, file, middle), "known_axes": axes, "known_sigma_mm": FIXED / MILLIMETRE}
        if not all(abs(covariance[k, k] / FIXED**2 - 1.0) < 1e-6 for k in range(3) if "xyz"[k] in axes):
            known["known_covariance_mm2"] = tuple(spread.tolist())
    return Target(
        **known,
        approximate_mm=rough if axes != "xyz" else None,
        datum=name in file.orientation,
        height_mm=together.target_heights.get(name, 0.0),
    )
