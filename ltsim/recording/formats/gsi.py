"""Leica GSI-8 and GSI-16: measurement blocks of theodolites, total stations and older trackers.

A block is a line of words: two digits of index, four of information, sign, 8 or 16 characters of data. Understood
are point (11), code (41 with the station's name in 42 and the instrument's height in 43), angles (21, 22), slope and
horizontal distance (31, 32), heights of target (87) and instrument (88), station coordinates (84 to 86). The format
fixes the meaning: directions count clockwise, 22 is a zenith angle, the unit stands in every word.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ltsim.errors import RecordError
from ltsim.recording.build import NAN, Pointing, recording_of
from ltsim.recording.conventions import NO_HINTS, Hints
from ltsim.recording.files import check_name, read_lines, shown
from ltsim.recording.recording import HEIGHT_COLUMNS, KIND_COLUMN, Recording
from ltsim.recording.setup import Instrument, Noise, Setup, Station, Target, Vector
from ltsim.units import DEGREE, GON

_WORD = re.compile(r"(\d\d)(.{4})([+-])(.{16}|.{8})", re.ASCII)
_PPM = re.compile(r"51.{4}[+-]\d{4,8}[+-]\d{3,7}", re.ASCII)
LENGTH = {"0": 1e-3, "1": 0.3048e-3, "6": 1e-4, "7": 0.3048e-4, "8": 1e-5, ".": 1e-3}
NOISE = Noise(distance_mm=1.0, distance_ppm=1.5, azimuth_arcsec=1.0, elevation_arcsec=1.0)
NO_NOISE = "GSI states no noise: 1 mm + 1.5 ppm and 1 arcsec of a total station are taken, edit setup.toml to state it"


@dataclass
class _File:
    path: Path
    station: str = ""
    instrument_height: float = 0.0
    setups: dict[str, tuple[str, float, Vector | None]] = field(default_factory=dict)
    pointings: list[Pointing] = field(default_factory=list)
    skipped: int = 0


def recognises(path: Path, head: str) -> bool:
    """Whether the first line is made of GSI words."""
    first = next((line for line in head.splitlines() if line.strip()), "")
    return re.match(r"\*?(11|41)\d{4}[+-]", first) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Read a GSI file.

    Raises
    ------
    RecordError
        For a word that is malformed, or measurements before a station is named (``hints.station`` names one).
    """
    file = _File(path)
    if hints.station is not None:
        _stand(hints.station, 0.0, None, file)
    lines = read_lines(path)
    before: dict[str, tuple[str, str]] = {}
    for i, line in enumerate(lines):
        if line.strip():
            words = _words(line.strip(), path, i + 1)
            if i == len(lines) - 1 and words.keys() != before.keys():
                raise RecordError("the last line has no line break: it was cut", file=path, row=i + 1)
            _block(words, file, i + 1)
            before = words
    if not file.pointings:
        raise RecordError("holds no measurements", file=path)
    return _finished(file)


def _words(line: str, path: Path, row: int) -> dict[str, tuple[str, str]]:
    """Information and signed data of each word by its index."""
    wide = line.startswith("*")
    words: dict[str, tuple[str, str]] = {}
    for text in line.lstrip("*").split(" "):
        found = _WORD.fullmatch(text)
        if not text or _PPM.fullmatch(text):
            continue
        if found is None or (len(found.group(4)) == 16) != wide:
            raise RecordError(f"'{shown(text)}' is no word of GSI-{16 if wide else 8}", file=path, row=row)
        words[found.group(1)] = (found.group(2), found.group(3) + found.group(4))
    return words


def _block(words: dict[str, tuple[str, str]], file: _File, row: int) -> None:
    """A station, a pointing, or something else."""
    if "41" in words and "42" in words:
        height = _length(words["43"], file, row) if "43" in words else 0.0
        _stand(_name(words["42"][1]), height, None, file, row)
    elif "84" in words and "85" in words and "11" in words and "21" not in words:
        x, y, z = (_length(words[k], file, row) if k in words else 0.0 for k in ("84", "85", "86"))
        height = _length(words["88"], file, row) if "88" in words else 0.0
        _stand(_name(words["11"][1]), height, (x * 1e3, y * 1e3, z * 1e3), file, row)
    elif "11" in words and any(k in words for k in ("21", "22", "31", "32")):
        _pointing(words, file, row)
    else:
        file.skipped += 1


def _stand(name: str, height: float, place: Vector | None, file: _File, row: int | None = None) -> None:
    """A new set-up; a station that is occupied again gets a number."""
    check_name(name, "station", file=file.path, row=row)
    count = sum(point == name for point, _, _ in file.setups.values())
    file.station = name if not count else f"{name}#{count + 1}"
    file.setups[file.station] = (name, height, place)


def _name(data: str) -> str:
    """The data of a name word without the zeros that fill it."""
    return data[1:].strip().lstrip("0") or "0"


def _number(word: tuple[str, str], file: _File, row: int) -> float:
    digits = word[1].replace(" ", "")
    if re.fullmatch(r"[+-]-+", digits):
        return NAN
    if re.fullmatch(r"[+-]\d+", digits, re.ASCII) is None:
        raise RecordError(f"found '{shown(word[1])}', expected digits", file=file.path, row=row)
    return float(digits)


def _length(word: tuple[str, str], file: _File, row: int) -> float:
    """Length [m] in the unit that the word names."""
    unit = word[0][-1]
    if unit not in LENGTH:
        raise RecordError(f"unit '{shown(unit)}' of a length, expected 0, 1, 6, 7 or 8", file=file.path, row=row)
    return _number(word, file, row) * LENGTH[unit]


def _angle(word: tuple[str, str], file: _File, row: int) -> float:
    """Angle [rad]: gon, decimal degrees, degrees-minutes-seconds or mils of 6400."""
    unit, value = word[0][-1], _number(word, file, row)
    if unit == "2":
        return value * 1e-5 * GON
    if unit == "3":
        return value * 1e-5 * DEGREE
    if unit == "4" and np.isfinite(value):
        degrees, rest = divmod(abs(value), 1e5)
        minutes, seconds = divmod(rest, 1e3)
        return float(np.sign(value) * (degrees + minutes / 60 + seconds / 36_000) * DEGREE)
    if unit == "5":
        return value * 1e-4 * 2 * np.pi / 6400
    if np.isnan(value):
        return NAN
    raise RecordError(f"unit '{shown(unit)}' of an angle, expected 2, 3, 4 or 5", file=file.path, row=row)


def _pointing(words: dict[str, tuple[str, str]], file: _File, row: int) -> None:
    if not file.station:
        message = "a measurement before any station is named; say which it is (station=)"
        raise RecordError(message, file=file.path, row=row)
    flat = "31" not in words
    key = "32" if flat else "31"
    distance = _length(words[key], file, row) if key in words else NAN
    horizontal = _angle(words["21"], file, row) if "21" in words else NAN
    zenith = _angle(words["22"], file, row) if "22" in words else NAN
    if not (np.isnan(distance) or 0 < distance < 1e6):
        if distance != 0:
            raise RecordError(f"a distance of {distance:g} m", file=file.path, row=row)
        distance = NAN
    if not (np.isnan(zenith) or 0 <= zenith <= 2 * np.pi):
        raise RecordError("a zenith angle off the circle", file=file.path, row=row)
    elevation = np.pi / 2 - zenith
    if elevation < -np.pi / 2:
        elevation += 2 * np.pi
    if np.all(np.isnan([distance, horizontal, zenith])):
        file.skipped += 1
        return
    height = _length(words["87"], file, row) * 1e3 if "87" in words else 0.0
    covariates = {HEIGHT_COLUMNS[1]: height} if np.isfinite(height) else {}
    labels = {KIND_COLUMN: "horizontal"} if flat and np.isfinite(distance) else {}
    face = 2 if elevation > np.pi / 2 + 1e-9 else 1
    azimuth = float(np.mod(-horizontal, 2 * np.pi))
    target = check_name(_name(words["11"][1]), "target", file=file.path, row=row)
    file.pointings.append(
        Pointing(
            file.station, target, face, distance, azimuth, float(elevation), covariates=covariates, labels=labels,
            source=f"{file.path.name}, line {row}",
        )
    )  # fmt: skip


def _finished(file: _File) -> Recording:
    targets = dict.fromkeys(p.target for p in file.pointings)
    used = dict.fromkeys(p.station for p in file.pointings)
    stations = {}
    for name in used:
        point, height, place = file.setups[name]
        stations[name] = Station(
            levelled=True,
            over=point if point in targets else None,
            instrument_height_mm=round(height * 1e3, 6),
            position_mm=place,
        )
    heights: dict[str, set[float]] = {}
    for p in file.pointings:
        heights.setdefault(p.target, set()).update(p.covariates.values())
    constant = all(len(found) <= 1 for found in heights.values())
    setup = Setup(
        title=file.path.stem,
        instrument=Instrument(noise=NOISE, corrected=True),
        stations=stations,
        targets={t: Target(height_mm=h.pop()) for t, h in heights.items() if h and any(h)} if constant else {},
    )
    notes = [NO_NOISE]
    if file.skipped:
        notes.append(f"{file.skipped} blocks are no station or measurement and left out")
    recording = recording_of(file.pointings, setup, notes=notes, file=file.path)
    return recording.replace(covariates={}) if constant else recording
