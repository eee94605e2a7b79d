"""Input files of CERN's LGC (``.lgc``, ``.lgc2``).

Understood are points (``*CALA``, ``*POIN``, ``*VXY`` and its kin, ``*PDOR``), polar instruments with the sigmas of
their targets, set-ups (``*TSTN``, ``*V0``), observations (``*PLR3D``, ``*ANGL``, ``*ZEND``, ``*DIST``, ``*DHOR``),
free rotation (``ROT3D``) and lines switched off with ``%``. Other observations are named in a note and skipped.
Angles count clockwise, in gon; coordinates and distances are in metres.

In a curved reference (``*RS2K`` and others) the third coordinate is a height. It is turned into the z of a plane that
touches the network in its middle, and every levelled set-up gets the direction of plumb that belongs to its place.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.recording.build import NAN, recording_of
from ltsim.recording.conventions import NO_HINTS, Hints
from ltsim.recording.files import MAX_TEXT, check_name, number, read_lines, shown
from ltsim.recording.merge import Kind, Merged, Observed, merged
from ltsim.recording.recording import Recording
from ltsim.recording.setup import EXACT_LEVEL_ARCSEC, Axes, Instrument, Noise, Setup, Station, Target, Vector
from ltsim.units import ARCSECOND, GON, MILLIMETRE, PPM

EARTH = 6_371_000.0
FIXED_MM = 1e-4
CC = GON * 1e-4
POINTS: dict[str, Axes | None] = {"CALA": "xyz", "VXY": "z", "VXZ": "y", "VYZ": "x", "VZ": "xy", "POIN": None}
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
WITH_VALUE = ("OBSE", "PPM", "TH", "THSE", "TCSE", "TRGT", "ID", "ASE", "ZSE", "DSE", "ACST", "IH", "IHSE", "ICSE")


@dataclass(frozen=True)
class _Sigmas:
    """Standard deviations by the target used: azimuth and zenith angle [rad], distance [m] and its part per metre."""

    azimuth: float
    elevation: float
    distance: float
    per_metre: float
    height: float


@dataclass
class _Polar:
    default: str
    height: float
    targets: dict[str, _Sigmas] = field(default_factory=dict)


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
    points: dict[str, tuple[Axes | None, Floats]] = field(default_factory=dict)
    orientation: list[str] = field(default_factory=list)
    polar: dict[str, _Polar] = field(default_factory=dict)
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
            if not in_frame:
                _begin(keyword, tokens[1:], file, row)
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
    for i, line in enumerate(read_lines(file.path, latin=True)):
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
        file.polar[name] = _Polar(rest[1], number(rest[2], file=file.path, row=row, column="height"))
    elif keyword == "TSTN":
        _begin_setup(rest, file, row)
    elif keyword == "V0":
        _begin_set(rest, file, row)
    elif keyword not in (*OPTIONS, *POINTS, *OBSERVATIONS, "FRAME", "ENDFRAME"):
        file.skipped.setdefault(keyword, 0)


def _begin_setup(rest: list[str], file: _File, row: int) -> None:
    if len(rest) < 2 or rest[1] not in file.polar:
        found = shown(rest[1]) if len(rest) > 1 else "nothing"
        raise RecordError(f"*TSTN names {found}, expected an instrument declared as *POLAR", file=file.path, row=row)
    point = check_name(rest[0], "station", file=file.path, row=row)
    if point not in file.points:
        raise RecordError(f"the set-up stands on {point}, which no block of points declares", file=file.path, row=row)
    options = _options(rest[2:], file, row)
    polar = file.polar[rest[1]]
    height = _option(options, "IH", polar.height if "IHFIX" in options else 0.0, file, row)
    file.station = point
    default = options.get("TRGT", polar.default)
    file.setups[_free_name(point, file)] = _SetUp(point, rest[1], height, "ROT3D" not in options, default)
    file.station = next(reversed(file.setups))


def _begin_set(rest: list[str], file: _File, row: int) -> None:
    """An orientation: the first of a set-up is its own, a further one makes a further set-up on the same point."""
    if not file.station:
        raise RecordError("*V0 without a set-up (*TSTN) before it", file=file.path, row=row)
    options = _options(rest, file, row)
    setup = file.setups[file.station]
    constant = _option(options, "ACST", 0.0, file, row) * GON
    if any(o.station == file.station for o in file.observed):
        setup = _SetUp(setup.point, setup.instrument, setup.height, setup.levelled, setup.default)
        file.station = _free_name(setup.point, file)
        file.setups[file.station] = setup
    setup.constant = constant
    setup.default = options.get("TRGT", setup.default)


def _free_name(point: str, file: _File) -> str:
    count = sum(s.point == point for s in file.setups.values())
    return point if not count else f"{point}#{count + 1}"


def _options(tokens: list[str], file: _File, row: int) -> dict[str, str]:
    """Words after the values: flags, and names with one value each."""
    found: dict[str, str] = {}
    rest = iter(tokens)
    for token in rest:
        word = token.upper()
        if word in WITH_VALUE:
            value = next(rest, None)
            if value is None:
                raise RecordError(f"{word} without a value", file=file.path, row=row)
            found[word] = value
        else:
            found[word] = ""
    return found


def _option(options: dict[str, str], name: str, default: float, file: _File, row: int) -> float:
    return number(options[name], file=file.path, row=row, column=name) if name in options else default


def _line(keyword: str, tokens: list[str], file: _File, row: int) -> bool:
    """A line of the current block; False where the block is of no use here."""
    if keyword in ("TITR", ""):
        file.title.append(" ".join(tokens))
    elif keyword in POINTS:
        name = check_name(tokens[0], "point", file=file.path, row=row)
        if len(tokens) < 4:
            raise RecordError("a point needs a name and three coordinates", file=file.path, row=row)
        values = [
            number(t, file=file.path, row=row, column=c, limit=1e8) for t, c in zip(tokens[1:4], "XYZ", strict=True)
        ]
        if name in file.points:
            raise RecordError(f"the point {name} is declared twice", file=file.path, row=row)
        file.points[name] = (POINTS[keyword], np.array(values))
    elif keyword == "PDOR":
        file.orientation.append(tokens[0])
    elif keyword == "POLAR":
        _target_line(tokens, file, row)
    elif keyword in OBSERVATIONS:
        _observation(keyword, tokens, file, row)
    else:
        return keyword in OPTIONS
    return True


def _target_line(tokens: list[str], file: _File, row: int) -> None:
    """Sigmas of one kind of target with the last instrument: angle and zenith [cc], distance [mm], mm per km."""
    if len(tokens) < 5:
        raise RecordError("a target needs its name and four sigmas", file=file.path, row=row)
    azimuth, elevation, distance, ppm = (number(t, file=file.path, row=row, column="sigma") for t in tokens[1:5])
    height = number(tokens[9], file=file.path, row=row, column="height") if len(tokens) > 9 else 0.0
    correction = number(tokens[6], file=file.path, row=row, column="correction") if len(tokens) > 6 else 0.0
    if correction:
        file.notes.append(f"target {shown(tokens[0])}: its correction of distances of {correction:g} m is not applied")
    sigmas = _Sigmas(azimuth * CC, elevation * CC, distance * MILLIMETRE, ppm * PPM, height)
    file.polar[next(reversed(file.polar))].targets[tokens[0]] = sigmas


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
    options = _options(tokens[1 + len(kinds) :], file, row)
    used = options.get("TRGT", setup.default)
    declared = file.polar[setup.instrument].targets
    if used not in declared:
        message = f"the target {shown(used)} is not declared with instrument {setup.instrument}"
        raise RecordError(message, file=file.path, row=row)
    height = _option(options, "TH", declared[used].height, file, row)
    for kind, text in zip(kinds, tokens[1:], strict=False):
        value = number(text, file=file.path, row=row, column=kind, limit=1e6)
        sigma = _sigma(kind, declared[used], options, value, file, row)
        si = _si(kind, value, setup, file, row)
        at = (setup.height, NAN if kind == "azimuth" else height)
        flat = keyword == "DHOR"
        file.observed.append(Observed(kind, file.station, target, si, sigma, *at, horizontal=flat))


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


def _sigma(kind: Kind, target: _Sigmas, options: dict[str, str], value: float, file: _File, row: int) -> float:
    """Standard deviation [m, rad] of one value: as declared with the target, or as the line says."""
    if kind == "distance":
        constant = _option(options, "DSE", _option(options, "OBSE", target.distance / MILLIMETRE, file, row), file, row)
        per_metre = _option(options, "PPM", target.per_metre / PPM, file, row) * PPM
        sigma = constant * MILLIMETRE + per_metre * value
    else:
        declared = (target.azimuth if kind == "azimuth" else target.elevation) / CC
        name = "ASE" if kind == "azimuth" else "ZSE"
        sigma = _option(options, name, _option(options, "OBSE", declared, file, row), file, row) * CC
    if not sigma > 0:
        raise RecordError("a standard deviation of 0", file=file.path, row=row, column=kind)
    return sigma


def _finished(file: _File) -> Recording:
    together = merged(file.observed)
    if not together.pointings:
        raise RecordError("holds no polar observations", file=file.path)
    targets = dict.fromkeys(p.target for p in together.pointings)
    marks = [s.point for s in file.setups.values() if file.points[s.point][0] or s.point in targets]
    used = dict.fromkeys([*targets, *marks, *(s.point for s in file.setups.values())])
    middle = _middle(file, list(used))
    setup = Setup(
        title=_title(file),
        instruments={name: Instrument(noise=_noise(polar), corrected=True) for name, polar in file.polar.items()},
        stations={name: _station(name, s, file, middle, marks, together) for name, s in file.setups.items()},
        targets={name: _target(name, file, middle, together) for name in dict.fromkeys([*targets, *marks])},
    )
    _say(file)
    return recording_of(together.pointings, setup, notes=list(dict.fromkeys(file.notes)), file=file.path)


def _middle(file: _File, names: list[str]) -> Floats:
    """Where the network lies in plan (2,) [m]; points at 0, 0 are place-holders."""
    plan = np.array([file.points[name][1][:2] for name in names])
    placed = plan[np.any(plan != 0, axis=1)]
    return np.asarray(np.median(placed, axis=0)) if len(placed) else np.zeros(2)


def _title(file: _File) -> str:
    text = " ".join(" ".join(file.title).split())[:MAX_TEXT]
    return "".join(c for c in text if c.isprintable() and c not in "<>")


def _say(file: _File) -> None:
    if file.switched_off:
        file.notes.append(f"{file.switched_off} lines are switched off with % and left out")
    for keyword, count in file.skipped.items():
        observed = "holds observed coordinates, no readings of an instrument,"
        why = observed if keyword == "OBSXYZ" else "is not understood here"
        file.notes.append(f"*{shown(keyword)} {why} and skipped ({count} lines)")
    if file.curved:
        sphere = "heights refer to a curved surface: a sphere is taken for it, plumb lines differ by place"
        file.notes.append(f"*{file.curved}: {sphere}")
    for name in file.orientation:
        file.notes.append(f"*PDOR: the frame is oriented by the approximate coordinates of {shown(name)}")


def _local(name: str, file: _File, middle: Floats) -> Vector:
    """Coordinates [mm] in the plane that touches the reference in the middle of the network."""
    x, y, height = file.points[name][1].tolist()
    drop = ((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * EARTH) if file.curved else 0.0
    return round(x * 1e3, 6), round(y * 1e3, 6), round((height - drop) * 1e3, 6)


def _is_placeholder(name: str, file: _File) -> bool:
    return not np.any(file.points[name][1][:2])


def _station(name: str, setup: _SetUp, file: _File, middle: Floats, marks: list[str], together: Merged) -> Station:
    vertical: Vector | None = None
    if file.curved and setup.levelled and not _is_placeholder(setup.point, file):
        x, y = ((file.points[setup.point][1][:2] - middle) / EARTH).round(12).tolist()
        vertical = (x, y, 1.0)
    rough = None if _is_placeholder(setup.point, file) else _local(setup.point, file, middle)
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
    axes = file.points[name][0]
    place = None if _is_placeholder(name, file) and not axes else _local(name, file, middle)
    return Target(
        known_mm=place if axes else None,
        known_axes=axes or "xyz",
        known_sigma_mm=FIXED_MM if axes else Target().known_sigma_mm,
        approximate_mm=place if axes != "xyz" else None,
        datum=name in file.orientation,
        height_mm=together.target_heights.get(name, 0.0),
    )


def _noise(polar: _Polar) -> Noise:
    """The sigmas of the default target; those of single observations stand in columns."""
    sigmas = polar.targets.get(polar.default) or next(iter(polar.targets.values()), None)
    if sigmas is None:
        return Noise()
    return Noise(
        distance_mm=max(sigmas.distance / MILLIMETRE, 1e-6),
        distance_ppm=sigmas.per_metre / PPM,
        azimuth_arcsec=max(sigmas.azimuth / ARCSECOND, 1e-6),
        elevation_arcsec=max(sigmas.elevation / ARCSECOND, 1e-6),
    )
