"""Format: OpenIndy projects (``oiProjectData`` XML), with readings of trackers in radians and metres.

The reader uses polar, direction, distance and cartesian readings. All observations of a point geometry belong to one
target. Each observation of a plane, sphere or other geometry is a different point and becomes a separate target.
OpenIndy's azimuth is counter-clockwise. Its readings are reduced to the front face; the zenith angle shows the face of
the measurement.
"""

from collections import Counter
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.geometry.polar import to_polar
from ltsim.recordings.files import safe_excerpt, single_line_title
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.pointings import NOT_MEASURED, Pointing, has_all_sigma_columns, recording_from_pointings
from ltsim.recordings.recording import SIGMA_COLUMNS, Recording
from ltsim.recordings.setup import Setup
from ltsim.recordings.specification import ASSUMED_TRACKER_NOISE_NOTE
from ltsim.recordings.xml import XmlNode, parse_xml

OPENINDY_ROOT_ELEMENT = "oiProjectData"
"""Root element of an OpenIndy project."""
REQUIRED_QUANTITIES_BY_READING_TYPE = {
    "polar": ("distance", "azimuth", "zenith"),
    "direction": ("azimuth", "zenith"),
    "distance": ("distance",),
    "cartesian": ("x", "y", "z"),
}
"""Quantities that a reading must contain, by type of reading."""
SIGMA_COLUMN_BY_MEASUREMENT = dict(zip(("distance", "azimuth", "zenith"), SIGMA_COLUMNS, strict=True))
"""Column of the recording for the standard deviation of each measured quantity."""


def recognises(path: Path, file_beginning: str) -> bool:
    """True if the file begins with the root element of an OpenIndy project."""
    return f"<{OPENINDY_ROOT_ELEMENT}" in file_beginning


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording from an OpenIndy project.

    Raises RecordError for malformed or unsafe XML, and for a reading without a required quantity.
    """
    root = parse_xml(path)
    if root.tag != OPENINDY_ROOT_ELEMENT:
        raise RecordError(f"the root is <{safe_excerpt(root.tag)}>, expected <{OPENINDY_ROOT_ELEMENT}>", file=path)
    named_nodes = [
        node for node in root.descendants("station", "geometry", "nominalGeometry") if node.attribute("name")
    ]
    stations = {node.required_attribute("id"): node for node in named_nodes if node.tag == "station"}
    geometries = {node.required_attribute("id"): node for node in named_nodes if node.tag != "station"}
    notes: Counter[str] = Counter()
    readings = [_parse_pointing(node, stations, geometries, notes) for node in root.descendants("observation")]
    pointings = [p for p in readings if p is not None]
    if not pointings:
        raise RecordError("the file contains no readings", file=path)
    first_time = np.min([p.time for p in pointings])
    pointings = [replace(p, time=p.time - first_time) for p in pointings]
    count_notes = [f"{count} {what}" for what, count in notes.items()]
    setup = Setup(title=single_line_title(root.attribute("name", path.stem)))
    recording = recording_from_pointings(pointings, setup, notes=count_notes, file=path)
    return (
        recording
        if has_all_sigma_columns(recording)
        else recording.replace(notes=(ASSUMED_TRACKER_NOISE_NOTE, *recording.notes))
    )


def _parse_pointing(
    node: XmlNode, stations: dict[str, XmlNode], geometries: dict[str, XmlNode], notes: Counter[str]
) -> Pointing | None:
    """Pointing in the XML element of an observation; None if the reading is not used, which is counted in `notes`."""
    children = {child.tag: child for child in node}
    if "reading" not in children:
        return None
    if "station" not in children:
        raise node.location.error("the observation has no station")
    reading, reference = children["reading"], children["station"].required_attribute("ref")
    kind = reading.attribute("type")
    if node.attribute("isValid") == "0" or kind not in REQUIRED_QUANTITIES_BY_READING_TYPE:
        notes[
            f"readings of the type {safe_excerpt(kind)} are not used"
            if kind not in REQUIRED_QUANTITIES_BY_READING_TYPE
            else "readings are declared invalid and are not used"
        ] += 1
        return None
    if reference not in stations:
        raise node.location.error(f"the reading refers to the station {safe_excerpt(reference)}, which does not exist")
    measurements = {m.required_attribute("type"): m for m in reading.descendants("measurement")}
    missing_names = [name for name in REQUIRED_QUANTITIES_BY_READING_TYPE[kind] if name not in measurements]
    if missing_names:
        raise node.location.error(f"the {kind} reading has no {missing_names[0]}")
    distance, azimuth, elevation = _polar_reading(
        {name: measurements[name].read_number("value", limit=1e6) for name in REQUIRED_QUANTITIES_BY_READING_TYPE[kind]}
    )
    if distance <= 0:
        raise node.location.error(f"found a distance of {distance:g}, expected one above 0")
    face = 2 if elevation > np.pi / 2 + 1e-9 else 1
    if (reading.attribute("face") == "2") != (face == 2):
        notes[
            "readings declare a face that contradicts their zenith angle; the face is taken from the zenith angle"
        ] += 1
    return Pointing(
        stations[reference].read_name("name", "station"),
        _target_name(node, geometries),
        face,
        distance,
        azimuth,
        elevation,
        _seconds_of_stamp(reading.attribute("time")),
        _sigmas_by_column(measurements),
        source=f"{node.file.name}, line {node.line}",
    )


def _polar_reading(values_by_observable: dict[str, float]) -> tuple[float, float, float]:
    """Range [m], azimuth [rad] and elevation [rad] of a reading; NaN if not measured.

    The elevation exceeds pi / 2 in face 2. `values_by_observable` contains ``x``, ``y``, ``z`` [m], or ``distance``
    [m], ``azimuth`` and ``zenith`` [rad].
    """
    if "x" in values_by_observable:
        d, a, e = to_polar(
            np.array([[values_by_observable["x"], values_by_observable["y"], values_by_observable["z"]]])
        )[0].tolist()
        return d, a, e
    elevation = np.pi / 2 - values_by_observable.get("zenith", NOT_MEASURED) % (2 * np.pi)
    if elevation < -np.pi / 2 - 1e-9:
        elevation += 2 * np.pi
    return (
        values_by_observable.get("distance", NOT_MEASURED),
        values_by_observable.get("azimuth", NOT_MEASURED) % (2 * np.pi),
        elevation,
    )


def _sigmas_by_column(nodes: dict[str, XmlNode]) -> dict[str, float]:
    """Standard deviations in the units of the recording, by column, from the elements of measured quantities."""
    sigmas = {
        name: nodes[name].read_number("sigma", 0.0, limit=1e6) for name in SIGMA_COLUMN_BY_MEASUREMENT if name in nodes
    }
    unit_by_measurement = {"distance": MILLIMETRE, "azimuth": ARCSECOND, "zenith": ARCSECOND}
    return {
        SIGMA_COLUMN_BY_MEASUREMENT[name]: sigma / unit_by_measurement[name]
        for name, sigma in sigmas.items()
        if sigma > 0
    }


def _target_name(node: XmlNode, geometries: dict[str, XmlNode]) -> str:
    """Name of the target of an observation: name of the point geometry, or a separate name on any other geometry.

    `geometries` are the XML elements of geometries by their id.
    """
    geometries_of_node = [
        geometries[e.attribute("ref")]
        for e in node.descendants("measuredTargetGeometry")
        if e.attribute("ref") in geometries
    ]
    point_geometry = next((geometry for geometry in geometries_of_node if geometry.attribute("type") == "point"), None)
    if point_geometry is not None:
        return point_geometry.read_name("name", "target")
    observation_id = node.required_attribute("id")
    return node.location.checked_name(
        f"{geometries_of_node[0].attribute('name')}.{observation_id}"
        if geometries_of_node
        else f"observation {observation_id}",
        "target",
    )


def _seconds_of_stamp(stamp: str) -> float:
    """Time [s] of an ISO date and time; NaN if the text is not one."""
    try:
        return datetime.fromisoformat(stamp).replace(tzinfo=None).timestamp()
    except (ValueError, OverflowError, OSError):
        return NOT_MEASURED
