"""Input files of GNU Gama (``gama-local``).

Understood are directions, azimuths, zenith angles, slope and horizontal distances, angles, heights of instrument and
target, points that are fixed, constrained, adjusted or observed with a covariance. Each set of directions becomes a
set-up of its own over the same point, azimuths an oriented one; distances alone between two targets are known lengths,
height differences and vectors known differences of their marks. Without any pointing they are no recording.

Gama's instruments are levelled exactly and its angles count clockwise unless said otherwise; a left-handed system of
axes is made right-handed by turning y over, which a note says.
"""

import re
from pathlib import Path

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.notation import listing
from ltsim.core.units import ARCSECOND, DEGREE, GON, MILLIMETRE, SI_PER_UNIT
from ltsim.recordings.air import NO_AIR_UNCERTAINTY
from ltsim.recordings.conventions import NO_HINTS, Hints
from ltsim.recordings.files import SourceLocation, as_title, quoted_text
from ltsim.recordings.formats.gama_network import (
    GamaNetwork,
    GamaPoint,
    covariance_entries,
    drop_undetermined_heights,
    read_differences,
    split_correlations,
    split_reference_lengths,
    with_distinct_names,
)
from ltsim.recordings.pointings import (
    NOT_MEASURED,
    SingleObservation,
    merge_observations,
    recording_of_pointings,
    separate_constant_heights,
)
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import check_differences
from ltsim.recordings.setup import (
    EXACT_LEVEL_ARCSEC,
    Gauge,
    Instrument,
    Noise,
    Setup,
    Station,
    Target,
)
from ltsim.recordings.xml import XmlNode, parse_xml

MIRRORED_AXES = ("ne", "sw", "es", "wn")
"""Axes of gama-local that form a left-handed frame: the sign of y is changed."""
DIRECT_AXES = ("en", "nw", "se", "ws")
CENTESIMAL_SECOND = SI_PER_UNIT["cc"]
STDEV_ATTRIBUTES = {"z-angle": "zenith-angle", "s-distance": "distance"} | {
    k: k for k in ("direction", "azimuth", "distance")
}
"""Attributes that hold the standard deviation, by kind of observation."""
NAME_ATTRIBUTES = ("id", "from", "to", "bs", "fs")
"""Attributes that name a point."""
SigmaAndSharedErrors = tuple[float, dict[str, float]]
"""Standard deviation of the independent part of an observation (NaN: the default), and the change by each shared error,
by name [mm, cc].
"""
CORRELATIONS_NOTE = "correlations between observed coordinates of different points are left out"
OMITTED_CORRELATIONS_NOTE = "correlations between height differences, or between vectors, are left out"
_DMS = re.compile(r"([+-]?)(\d{1,3})-(\d{1,2})-(\d{1,2}(?:\.\d+)?)", re.ASCII)


def recognises(path: Path, head: str) -> bool:
    """True if the root element is that of gama-local."""
    return re.search(r"<gama-(local|xml)\b", head) is not None and "<gama-local-adjustment" not in head


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording of an input file of gama-local.

    Raises RecordError for XML that is malformed, unsafe or of another kind.
    """
    root = parse_xml(path)
    if root.tag not in ("gama-local", "gama-xml"):
        raise RecordError(f"the root is <{quoted_text(root.tag)}>, expected <gama-local>", file=path)
    network = GamaNetwork(path)
    _without_slashes(root, network)
    for node in root.descendants("network", "description", "parameters"):
        if node.tag == "network":
            _read_axes(node, network)
        elif node.tag == "description":
            network.title = as_title(node.text)
        else:
            _read_parameters(node, network)
    for section in root.descendants("points-observations"):
        network.stdev |= {k.removesuffix("-stdev"): v for k, v in section.element.attrib.items() if k[-6:] == "-stdev"}
        for node in section:
            _read_part(node, network)
    return _make_recording(network)


def _without_slashes(root: XmlNode, network: GamaNetwork) -> None:
    """Replacement of `/` in names of points by `_`, because target names must not contain it.

    `..` is not permitted either.
    """
    attributes = [(element, key) for element in root.element.iter() for key in NAME_ATTRIBUTES if key in element.attrib]
    given = dict.fromkeys(element.attrib[key] for element, key in attributes)
    names: dict[str, str] = {}
    for name in (name for name in given if "/" in name and ".." not in name):
        names[name] = name.replace("/", "_")
        while names[name] in given or list(names.values()).count(names[name]) > 1:
            names[name] += "_"
    for element, key in attributes:
        element.attrib[key] = names.get(element.attrib[key], element.attrib[key])
    if names:
        network.notes.append(f"'/' in names of points is written '_': {listing([*names.values()], 3)}")


def _read_axes(node: XmlNode, network: GamaNetwork) -> None:
    axes, angles = node.get("axes-xy", "ne"), node.get("angles", "left-handed")
    if axes not in (*MIRRORED_AXES, *DIRECT_AXES) or angles not in ("left-handed", "right-handed"):
        message = f"axes-xy='{quoted_text(axes)}', angles='{quoted_text(angles)}' is not a system of gama-local"
        raise node.location.error(message)
    network.y_sign = -1.0 if axes in MIRRORED_AXES else 1.0
    network.angle_sign = -1.0 if angles == "left-handed" else 1.0
    network.north_direction_deg = {"n": 0.0, "e": 90.0, "s": 180.0, "w": -90.0}[axes[0]]
    if network.y_sign < 0:
        network.notes.append(f"axes-xy='{axes}' is a left-handed system: y is turned over to make it right-handed")


def _read_parameters(node: XmlNode, network: GamaNetwork) -> None:
    network.apriori = node.number("sigma-apr", network.apriori)
    if "sigma-apr" in node:
        apriori = quoted_text(node.get("sigma-apr"))
        network.notes.append(f"sigma-apr is {apriori}: Gama's sigma0 is this factor times the one of ltsim")
    if "latitude" in node or "ellipsoid" in node:
        network.notes.append("latitude and ellipsoid are not used: no reduction of observations to an ellipsoid")


def _read_part(node: XmlNode, network: GamaNetwork) -> None:
    if node.tag == "point":
        _read_point(node, network)
    elif node.tag == "obs":
        _read_obs(node, network)
    elif node.tag == "coordinates":
        _read_coordinates(node, network)
    elif node.tag in ("height-differences", "vectors"):
        differences, correlated = read_differences(node, network.y_sign, network.apriori)
        network.differences += differences
        network.notes += [OMITTED_CORRELATIONS_NOTE] * correlated
    else:
        network.skipped[node.tag] += 1


def _read_point(node: XmlNode, network: GamaNetwork) -> GamaPoint:
    """Point of an element: known (fixed) along some axes, approximate along the others.

    Capital letters define the datum.
    """
    name = node.name("id", "point")
    point = network.points.setdefault(name, GamaPoint())
    sign = {"x": 1.0, "y": network.y_sign, "z": 1.0}
    point.values.update({axis: sign[axis] * node.number(axis) for axis in "xyz" if axis in node})
    fixed, adjusted = node.get("fix"), node.get("adj")
    for word in (fixed, adjusted):
        if word.lower() not in ("", "xyz", "xy", "z"):
            raise node.location.error(f"point {name}: '{quoted_text(word)}' is not one of xyz, xy, z")
    if any(axis not in point.values for axis in fixed.lower()):
        raise node.location.error(f"point {name} is fixed, but lacks coordinates")
    point.fixed = "".join(sorted({*point.fixed, *fixed.lower()}))
    point.datum = _parse_axes(point.datum + "".join(filter(str.isupper, adjusted)))
    point.active = _parse_axes(point.active + fixed + adjusted)
    return point


def _parse_axes(letters: str) -> str:
    return "".join(axis for axis in "xyz" if axis in letters.lower())


def _read_coordinates(node: XmlNode, network: GamaNetwork) -> None:
    """Observed coordinates of an element, known with their covariance; correlations between points are ignored."""
    row, column, numbers = covariance_entries(node)
    sign, at = np.array([1.0, network.y_sign, 1.0]), 0
    for inner in [inner for inner in node if inner.tag == "point"]:
        point, axes = _read_point(inner, network), [i for i, axis in enumerate("xyz") if axis in inner]
        first, at = at, at + len(axes)
        mine = (row >= first) & (row < at)
        inside = mine & (column < at)
        covariance, (i, j) = np.eye(3), np.array(axes, dtype=np.int64)[np.stack([row[inside], column[inside]]) - first]
        covariance[i, j] = covariance[j, i] = numbers[inside]
        variances = np.diag(covariance)[axes]
        if np.count_nonzero(i == j) < len(axes) or not np.all(variances > 0):
            raise inner.location.error("observed coordinates need a variance each")
        if np.any(numbers[mine & ~inside]):
            network.notes.append(CORRELATIONS_NOTE)
        point.fixed = "".join("xyz"[axis] for axis in axes)
        point.sigma = float(np.sqrt(np.mean(variances)))
        if np.any(np.triu(covariance, 1)) or max(variances) > 1.0001 * min(variances):
            point.covariance = tuple((covariance * np.outer(sign, sign))[np.triu_indices(3)].tolist())


def _read_obs(block: XmlNode, network: GamaNetwork) -> None:
    """Observations of a block, from one point or from the `from` of each observation."""
    inner = [child for child in block if child.tag != "cov-mat"]
    row, column, numbers = covariance_entries(block)
    if len(numbers) and row[-1] + 1 != len(inner):
        raise block.location.error("a <cov-mat> that does not match its observations")
    sigmas, reach = [NOT_MEASURED] * len(inner), np.zeros((len(inner), 0))
    if len(numbers):
        alone, reach = split_correlations(block, (row, column, numbers), network.shared)
        sigmas = alone.tolist()
    shared = [{f"{network.shared + k}": errors[k] for k in np.flatnonzero(errors)} for errors in reach]
    network.shared += reach.shape[1]
    circles = {(_start_point(child, block), child.tag) for child in inner if child.tag in ("direction", "azimuth")}
    names = {circle: network.station(circle[0], with_directions=True) for circle in sorted(circles, reverse=True)}
    network.oriented |= {name for (_, kind), name in names.items() if kind == "azimuth"}
    for child, sigma, errors in zip(inner, sigmas, shared, strict=True):
        if child.tag in STDEV_ATTRIBUTES:
            point = _start_point(child, block)
            station = names.get((point, child.tag)) or names.get((point, "direction")) or network.station(point)
            network.observed.append(_observation(child, block, station, (sigma, errors), network))
        elif child.tag == "angle":
            _read_angle(child, block, (sigma, errors), network)
        else:
            network.skipped[child.tag] += 1


def _start_point(child: XmlNode, block: XmlNode) -> str:
    return (child if "from" in child else block).name("from", "point")


def _observation(
    child: XmlNode, block: XmlNode, station: str, spread: SigmaAndSharedErrors, network: GamaNetwork
) -> SingleObservation:
    target = child.name("to", "point")
    heights = child.number("from_dh", block.number("from_dh", 0.0)), child.number("to_dh", 0.0)
    if child.tag in ("s-distance", "distance"):
        value = child.number("val")
        if not 0 < value < 1e6:
            raise child.location.error(f"found {value:g}, expected a distance above 0", f"<{child.tag}> val")
        sigma, shared = _scale_sigma(spread, MILLIMETRE, child, network, value)
        flat = child.tag == "distance"
        return SingleObservation("distance", station, target, value, sigma, *heights, flat, child.line, shared)
    value, second = _parse_angle(child)
    sense = network.angle_sign if child.tag in ("direction", "azimuth") else -1.0
    sigma, shared = _scale_sigma(spread, sense * second, child, network)
    if child.tag in ("direction", "azimuth"):
        return SingleObservation("azimuth", station, target, sense * value, sigma, line=child.line, shared=shared)
    if value > np.pi:
        raise child.location.error("a zenith angle beyond half a circle", "<z-angle> val")
    return SingleObservation(
        "elevation", station, target, np.pi / 2 - value, sigma, *heights, line=child.line, shared=shared
    )


def _read_angle(child: XmlNode, block: XmlNode, spread: SigmaAndSharedErrors, network: GamaNetwork) -> None:
    """Angle as two directions of a separate orientation, each with its sigma divided by the square root of 2."""
    station = network.station(_start_point(child, block), with_directions=True)
    value, second = _parse_angle(child)
    sigma, shared = _scale_sigma(spread, network.angle_sign * second, child, network)
    for name, turned, errors in (("bs", 0.0, {}), ("fs", network.angle_sign * value, shared)):
        target = child.name(name, "point")
        direction = SingleObservation(
            "azimuth", station, target, turned, sigma / np.sqrt(2), line=child.line, shared=errors
        )
        network.observed.append(direction)


def _scale_sigma(
    spread: SigmaAndSharedErrors, unit: float, child: XmlNode, network: GamaNetwork, distance: float = 0.0
) -> tuple[float, dict[str, float]]:
    """Standard deviation and shared errors multiplied by a unit, with the sign of the sense of the reading."""
    sigma, shared = spread
    alone = sigma if np.isfinite(sigma) else _sigma_of_observation(child, network, distance)
    return alone * abs(unit), {name: error * unit for name, error in shared.items()}


def _parse_angle(child: XmlNode) -> tuple[float, float]:
    """Angle [rad] from gon or degrees-minutes-seconds, and the unit [rad] of its standard deviation."""
    match = _DMS.fullmatch(child.required_attribute("val"))
    if match is None:
        return child.number("val", limit=1e4) * GON, CENTESIMAL_SECOND
    degrees = float(match[2]) + float(match[3]) / 60 + float(match[4]) / 3600
    return (-degrees if match[1] == "-" else degrees) * DEGREE, ARCSECOND


def _sigma_of_observation(child: XmlNode, network: GamaNetwork, distance: float = 0.0) -> float:
    """Standard deviation of an observation, or the default: ``a``, or ``a b c`` for a + b D^c with D in km."""
    kind = STDEV_ATTRIBUTES.get(child.tag, child.tag)
    words = child.get("stdev", network.stdev.get(kind, "")).split()
    if not 0 < len(words) < 4:
        message = (
            f"no standard deviation is given for <{quoted_text(child.tag)}>, expected one (stdev, or {kind}-stdev)"
        )
        raise child.location.error(message)
    coefficients = [child.location.number(word, "stdev", limit=1e9) for word in words]
    a, b, c = [*coefficients, 0.0, 1.0][:3] if len(coefficients) == 1 else [*coefficients, 1.0][:3]
    sigma = a + (b * (distance / 1000) ** c if b else 0.0)
    if not 0 < sigma < 1e9:
        raise child.location.error(f"a standard deviation of {sigma:g}", f"<{quoted_text(child.tag)}>")
    return sigma


def _make_recording(network: GamaNetwork) -> Recording:
    drop_undetermined_heights(network)
    gauge, observed = split_reference_lengths(network)
    pointings, instrument_heights, target_heights = separate_constant_heights(
        merge_observations(observed, network.file.name)
    )
    no_place = "not read: a recording cannot contain it"
    skipped = [f"{count} <{quoted_text(what)}> {no_place}" for what, count in network.skipped.items()]
    if not pointings and network.differences:
        message = "contains height differences or vectors without pointings, expected readings of instruments too"
        raise RecordError(f"{message}; gama-local adjusts such a network", file=network.file)
    if not pointings and skipped:
        raise RecordError(f"contains no pointings, and {'; '.join(skipped)}", file=network.file)
    network.notes += skipped
    stations = {
        name: Station(
            levelled=True,
            levelling_sigma_arcsec=EXACT_LEVEL_ARCSEC,
            over=network.point_of_station[name],
            position_mm=network.points.get(network.point_of_station[name], GamaPoint()).place,
            yaw_deg=network.north_direction_deg if name in network.oriented else None,
            yaw_sigma_arcsec=EXACT_LEVEL_ARCSEC if name in network.oriented else None,
            instrument_height_mm=instrument_heights.get(name, 0.0),
        )
        for name in dict.fromkeys(p.station for p in pointings)
    }
    names = dict.fromkeys([*network.points, *target_heights])
    setup = Setup(
        title=network.title,
        air=NO_AIR_UNCERTAINTY,
        instrument=Instrument(noise=_noise(network), corrected=True),
        gauge=Gauge(distance=tuple(gauge)) if gauge else None,
        stations=stations,
        targets={n: _target(network.points.get(n, GamaPoint()), target_heights.get(n, 0.0)) for n in names},
        differences=tuple(with_distinct_names(network.differences)),
    )
    recording = recording_of_pointings(pointings, setup, notes=list(dict.fromkeys(network.notes)), file=network.file)
    check_differences(recording, network.file)
    return recording


def _target(point: GamaPoint, height: float) -> Target:
    reference = {"known_axes": point.fixed, "known_sigma_mm": point.sigma, "known_covariance_mm2": point.covariance}
    return Target(
        known_mm=point.coordinates if point.fixed else None,
        **reference if point.fixed else {},  # type: ignore[arg-type]
        in_plan=point.active == "xy",
        approximate_mm=None if point.fixed == "xyz" else point.place,
        datum=bool(point.datum),
        datum_axes=point.datum or "xyz",  # type: ignore[arg-type]
        height_mm=height,
    )


def _noise(network: GamaNetwork) -> Noise:
    """Default standard deviations of the file; those of single observations are in columns."""

    def default(kind: str, fallback: float) -> float:
        words = network.stdev.get(kind, "").split()
        value = SourceLocation(network.file).number(words[0], f"{kind}-stdev") if words else fallback
        return max(value, 1e-6)

    return Noise(
        distance_mm=default("distance", 1.0),
        distance_ppm=0.0,
        azimuth_arcsec=default("direction", 3.0) * CENTESIMAL_SECOND / ARCSECOND,
        elevation_arcsec=default("zenith-angle", 3.0) * CENTESIMAL_SECOND / ARCSECOND,
    )
