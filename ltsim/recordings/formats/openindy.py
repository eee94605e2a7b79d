"""Format: OpenIndy projects (``oiProjectData`` XML), readings of trackers in radians and metres.

Polar, direction, distance and cartesian readings are taken. Observations of a point geometry belong to one target;
those of planes, spheres and the like touch another place each and become targets of their own. OpenIndy's azimuth
runs counter-clockwise. Its readings are reduced to the front face: the face is taken from the zenith angle.
"""

from collections import Counter
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.geometry.polar import to_polar
from ltsim.recordings.conventions import NO_HINTS, Hints
from ltsim.recordings.files import as_title, quoted_text
from ltsim.recordings.pointings import NOT_MEASURED, Pointing, declares_noise, recording_of_pointings
from ltsim.recordings.recording import SIGMA_COLUMNS, Recording
from ltsim.recordings.setup import Setup
from ltsim.recordings.specification import NO_NOISE_NOTE
from ltsim.recordings.xml import XmlNode, parse_xml

ROOT_ELEMENT = "oiProjectData"
READINGS_BY_TYPE = {
    "polar": ("distance", "azimuth", "zenith"),
    "direction": ("azimuth", "zenith"),
    "distance": ("distance",),
    "cartesian": ("x", "y", "z"),
}
"""Readings of each type of observation that is read."""
SIGMA_ATTRIBUTES = dict(zip(("distance", "azimuth", "zenith"), SIGMA_COLUMNS, strict=True))


def recognises(path: Path, head: str) -> bool:
    """True if the root element is an OpenIndy project."""
    return f"<{ROOT_ELEMENT}" in head


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording of an OpenIndy project.

    Raises RecordError for XML that is malformed or unsafe, or a reading that lacks a measurement.
    """
    root = parse_xml(path)
    if root.tag != ROOT_ELEMENT:
        raise RecordError(f"the root is <{quoted_text(root.tag)}>, expected <{ROOT_ELEMENT}>", file=path)
    named_nodes = [node for node in root.descendants("station", "geometry", "nominalGeometry") if node.get("name")]
    stations = {node.required_attribute("id"): node for node in named_nodes if node.tag == "station"}
    geometries = {node.required_attribute("id"): node for node in named_nodes if node.tag != "station"}
    notes: Counter[str] = Counter()
    readings = [_pointing(node, stations, geometries, notes) for node in root.descendants("observation")]
    pointings = [p for p in readings if p is not None]
    if not pointings:
        raise RecordError("holds no readings", file=path)
    first_time = np.min([p.time for p in pointings])
    pointings = [replace(p, time=p.time - first_time) for p in pointings]
    counts = [f"{count} {what}" for what, count in notes.items()]
    setup = Setup(title=as_title(root.get("name", path.stem)))
    recording = recording_of_pointings(pointings, setup, notes=counts, file=path)
    return recording if declares_noise(recording) else recording.replace(notes=(NO_NOISE_NOTE, *recording.notes))


def _pointing(
    node: XmlNode, stations: dict[str, XmlNode], geometries: dict[str, XmlNode], notes: Counter[str]
) -> Pointing | None:
    inner = {child.tag: child for child in node}
    if "reading" not in inner:
        return None
    if "station" not in inner:
        raise node.location.error("an observation without its station")
    reading, reference = inner["reading"], inner["station"].required_attribute("ref")
    kind = reading.get("type")
    if node.get("isValid") == "0" or kind not in READINGS_BY_TYPE:
        notes[
            f"readings of the type {quoted_text(kind)} left out"
            if kind not in READINGS_BY_TYPE
            else "invalid readings left out"
        ] += 1
        return None
    if reference not in stations:
        raise node.location.error(f"a reading refers to station {quoted_text(reference)}, which does not exist")
    measured = {m.required_attribute("type"): m for m in reading.descendants("measurement")}
    missing_names = [name for name in READINGS_BY_TYPE[kind] if name not in measured]
    if missing_names:
        raise node.location.error(f"a {kind} reading lacks its {missing_names[0]}")
    distance, azimuth, elevation = _polar_reading(
        {name: measured[name].number("value", limit=1e6) for name in READINGS_BY_TYPE[kind]}
    )
    if distance <= 0:
        raise node.location.error(f"found a distance of {distance:g}, expected one above 0")
    face = 2 if elevation > np.pi / 2 + 1e-9 else 1
    if (reading.get("face") == "2") != (face == 2):
        notes["readings have a face that contradicts their zenith angle: the face of the zenith angle is used"] += 1
    return Pointing(
        stations[reference].name("name", "station"),
        _target_name(node, geometries),
        face,
        distance,
        azimuth,
        elevation,
        _seconds_of_stamp(reading.get("time")),
        _sigmas(measured),
        source=f"{node.file.name}, line {node.line}",
    )


def _polar_reading(values: dict[str, float]) -> tuple[float, float, float]:
    """Range, azimuth and raw elevation; NaN for a missing measurement."""
    if "x" in values:
        d, a, e = to_polar(np.array([[values["x"], values["y"], values["z"]]]))[0].tolist()
        return d, a, e
    elevation = np.pi / 2 - values.get("zenith", NOT_MEASURED) % (2 * np.pi)
    if elevation < -np.pi / 2 - 1e-9:
        elevation += 2 * np.pi
    return values.get("distance", NOT_MEASURED), values.get("azimuth", NOT_MEASURED) % (2 * np.pi), elevation


def _sigmas(nodes: dict[str, XmlNode]) -> dict[str, float]:
    sigmas = {name: nodes[name].number("sigma", 0.0, limit=1e6) for name in SIGMA_ATTRIBUTES if name in nodes}
    unit = {"distance": MILLIMETRE, "azimuth": ARCSECOND, "zenith": ARCSECOND}
    return {SIGMA_ATTRIBUTES[name]: sigma / unit[name] for name, sigma in sigmas.items() if sigma > 0}


def _target_name(node: XmlNode, geometries: dict[str, XmlNode]) -> str:
    """Name of the target: the point geometry, or a separate name for a reading of another geometry."""
    touched = [
        geometries[e.get("ref")] for e in node.descendants("measuredTargetGeometry") if e.get("ref") in geometries
    ]
    point = next((geometry for geometry in touched if geometry.get("type") == "point"), None)
    if point is not None:
        return point.name("name", "target")
    number = node.required_attribute("id")
    return node.location.name(f"{touched[0].get('name')}.{number}" if touched else f"observation {number}", "target")


def _seconds_of_stamp(stamp: str) -> float:
    try:
        return datetime.fromisoformat(stamp).replace(tzinfo=None).timestamp()
    except (ValueError, OverflowError, OSError):
        return NOT_MEASURED
