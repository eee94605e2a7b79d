"""OpenIndy projects (``oiProjectData`` XML): readings of trackers with radians and metres inside.

Polar, direction, distance and cartesian readings are taken. Observations of a point geometry belong to one target;
those of planes, spheres and the like touch another place each and become targets of their own. OpenIndy's azimuth
runs counter-clockwise. Its readings are reduced to the front face: the face is taken from the zenith angle.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ltsim.errors import RecordError
from ltsim.geometry.polar import to_polar
from ltsim.recording.build import NAN, Pointing, recording_of
from ltsim.recording.conventions import NO_HINTS, NO_NOISE, Hints
from ltsim.recording.files import check_name, number, shown
from ltsim.recording.formats.xml import attribute, line_of, parse, tag
from ltsim.recording.recording import SIGMA_COLUMNS, Recording
from ltsim.recording.setup import Setup
from ltsim.units import ARCSECOND, MILLIMETRE

ROOT = "oiProjectData"
WANTED = {
    "polar": ("distance", "azimuth", "zenith"),
    "direction": ("azimuth", "zenith"),
    "distance": ("distance",),
    "cartesian": ("x", "y", "z"),
}
SIGMAS = dict(zip(("distance", "azimuth", "zenith"), SIGMA_COLUMNS, strict=True))


def recognises(path: Path, head: str) -> bool:
    """Whether the root element is a project of OpenIndy."""
    return f"<{ROOT}" in head


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Read an OpenIndy project.

    Raises
    ------
    RecordError
        For XML that is malformed or hostile, or a reading that lacks a measurement.
    """
    root = parse(path)
    if tag(root) != ROOT:
        raise RecordError(f"the root is <{shown(tag(root))}>, expected <{ROOT}>", file=path)
    stations = {attribute(e, "id", path): attribute(e, "name", path) for e in root.iter("station") if e.get("name")}
    geometries = {
        attribute(e, "id", path): (attribute(e, "name", path), e.get("type", ""))
        for kind in ("geometry", "nominalGeometry")
        for e in root.iter(kind)
        if e.get("name")
    }
    notes: dict[str, int] = {}
    observations = [e for e in root.iter("observation") if e.find("reading") is not None]
    found = [_pointing(element, stations, geometries, notes, path) for element in observations]
    pointings = [p for p in found if p is not None]
    if not pointings:
        raise RecordError("holds no readings", file=path)
    said = [f"{count} {what}" for what, count in notes.items()]
    title = root.get("name", path.stem)
    title = "".join(c for c in title if c.isprintable() and c not in "<>")[:200]
    return recording_of(_from_start(pointings), Setup(title=title), notes=[*said, NO_NOISE], file=path)


def _pointing(
    element: Element,
    stations: dict[str, str],
    geometries: dict[str, tuple[str, str]],
    notes: dict[str, int],
    path: Path,
) -> Pointing | None:
    reading, station = element.find("reading"), element.find("station")
    if reading is None or station is None:
        raise RecordError("an observation without its station", file=path)
    kind = reading.get("type", "")
    if element.get("isValid") == "0" or kind not in WANTED:
        what = f"readings of the type {shown(kind)} left out" if kind not in WANTED else "invalid readings left out"
        notes[what] = notes.get(what, 0) + 1
        return None
    reference = attribute(station, "ref", path)
    if reference not in stations:
        raise RecordError(f"a reading refers to station {shown(reference)}, which is not there", file=path)
    values, sigmas = _measurements(reading, kind, path)
    distance, azimuth, elevation = _polar(kind, values)
    if np.isfinite(distance) and distance <= 0:
        raise RecordError(f"found a distance of {distance:g}, expected one above 0", file=path)
    face = 2 if elevation > np.pi / 2 + 1e-9 else 1
    if (reading.get("face") == "2") != (face == 2):
        what = "readings state another face than their zenith angle shows: the angle is trusted"
        notes[what] = notes.get(what, 0) + 1
    return Pointing(
        check_name(stations[reference], "station", file=path),
        _target(element, geometries, path),
        face,
        distance,
        azimuth,
        elevation,
        _seconds(reading.get("time", "")),
        sigmas,
        source=f"{path.name}, line {line_of(element)}",
    )


def _measurements(reading: Element, kind: str, path: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Values [m, rad] and stated standard deviations by column."""
    values: dict[str, float] = {}
    sigmas: dict[str, float] = {}
    for element in reading.iter("measurement"):
        name = attribute(element, "type", path)
        values[name] = number(attribute(element, "value", path), file=path, column=shown(name), limit=1e6)
        sigma = number(element.get("sigma", "0"), file=path, column=shown(name), limit=1e6)
        if name in SIGMAS and sigma > 0:
            sigmas[SIGMAS[name]] = sigma / (MILLIMETRE if name == "distance" else ARCSECOND)
    missing = [name for name in WANTED[kind] if name not in values]
    if missing:
        raise RecordError(f"a {kind} reading lacks its {missing[0]}", file=path)
    return values, sigmas


def _polar(kind: str, values: dict[str, float]) -> tuple[float, float, float]:
    """Range, azimuth and raw elevation."""
    if kind == "cartesian":
        d, a, e = to_polar(np.array([[values["x"], values["y"], values["z"]]]))[0].tolist()
        return d, a, e
    distance = values["distance"] if "distance" in WANTED[kind] else NAN
    if kind == "distance":
        return distance, NAN, NAN
    elevation = np.pi / 2 - values["zenith"] % (2 * np.pi)
    if elevation < -np.pi / 2 - 1e-9:
        elevation += 2 * np.pi
    return distance, float(values["azimuth"] % (2 * np.pi)), float(elevation)


def _target(element: Element, geometries: dict[str, tuple[str, str]], path: Path) -> str:
    """Name of the point geometry, or one of its own for a touch of anything else."""
    names = [geometries[ref] for e in element.iter("measuredTargetGeometry") if (ref := e.get("ref", "")) in geometries]
    point = next((name for name, kind in names if kind == "point"), None)
    if point is None:
        number_ = attribute(element, "id", path)
        point = f"{names[0][0]}.{number_}" if names else f"observation {number_}"
    return check_name(point, "target", file=path)


def _seconds(stamp: str) -> float:
    try:
        return datetime.fromisoformat(stamp).replace(tzinfo=None).timestamp()
    except (ValueError, OverflowError, OSError):
        return NAN


def _from_start(pointings: list[Pointing]) -> list[Pointing]:
    first = min(p.time for p in pointings) if all(np.isfinite(p.time) for p in pointings) else NAN
    return [Pointing(**{**vars(p), "time": p.time - first}) for p in pointings]
