"""Format: input files of GNU Gama (``gama-local``).

The reader supports directions, azimuths, zenith angles, slope and horizontal distances, angles, heights of instrument
and target, and points that are fixed, constrained, adjusted or observed with a covariance. Each set of directions
becomes a separate set-up over one point; azimuths become a set-up of known orientation. A distance between two points
without other measurements becomes a reference length; height differences and vectors become known vectors between
survey marks. A file without pointings is not a recording.

Gama's instruments are levelled exactly; its angles are clockwise unless the file declares otherwise. In a left-handed
system of axes the sign of y is changed, which a note reports.
"""

import re
from pathlib import Path

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.notation import names_text
from ltsim.core.units import ARCSECOND, CENTESIMAL_SECOND, DEGREE, GON, MILLIMETRE
from ltsim.recordings.air import NO_AIR_UNCERTAINTY
from ltsim.recordings.files import MAX_RECORDING_NAME_LENGTH, SourceLocation, safe_excerpt, single_line_title
from ltsim.recordings.formats.gama_network import (
    GamaNetwork,
    GamaPoint,
    covariance_entries,
    differences_with_distinct_names,
    drop_height_dependent_observations,
    read_differences,
    split_correlations,
    split_reference_lengths,
)
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.pointings import (
    NOT_MEASURED,
    SingleObservation,
    pointings_from_observations,
    recording_from_pointings,
    separate_constant_heights,
)
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import check_reference_difference_ends
from ltsim.recordings.setup import EXACT_LEVELLING_SIGMA_ARCSEC, Instrument, LengthGauge, Noise, Setup, Station, Target
from ltsim.recordings.xml import XmlNode, parse_xml

MIRRORED_AXES = ("ne", "sw", "es", "wn")
"""Directions (n, e, s or w) of the x and y axes that form a left-handed system, for which the sign of y is changed."""
UNMIRRORED_AXES = ("en", "nw", "se", "ws")
"""Directions (n, e, s or w) of the x and y axes that form a right-handed system."""
STDEV_ATTRIBUTE_PREFIXES = {"z-angle": "zenith-angle", "s-distance": "distance"} | {
    k: k for k in ("direction", "azimuth", "distance")
}
"""Beginning of the attribute of the default sigma (``direction`` of ``direction-stdev``), by element of an observation.
"""
POINT_NAME_ATTRIBUTES = ("id", "from", "to", "bs", "fs")
"""XML attributes that contain the name of a point."""
SigmaAndSharedErrors = tuple[float, dict[str, float]]
"""Standard deviation of the independent error of an observation (NaN for the default of the file), and change of the
observation by one standard deviation of each shared error, by name of the error [mm, cc]."""
IGNORED_POINT_CORRELATIONS_NOTE = "correlations between observed coordinates of different points are not used"
"""Note for the user on ignored correlations in ``<coordinates>``."""
IGNORED_DIFFERENCE_CORRELATIONS_NOTE = "correlations between height differences, or between vectors, are not used"
"""Note for the user on ignored correlations in ``<height-differences>`` and ``<vectors>``."""
_SEXAGESIMAL_ANGLE_PATTERN = re.compile(r"([+-]?)(\d{1,3})-(\d{1,2})-(\d{1,2}(?:\.\d+)?)", re.ASCII)
"""Pattern of an angle as degrees-minutes-seconds."""


def recognises(path: Path, file_beginning: str) -> bool:
    """True if the file begins with the root element of an input file of gama-local."""
    return (
        re.search(r"<gama-(local|xml)\b", file_beginning) is not None and "<gama-local-adjustment" not in file_beginning
    )


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording of an input file of gama-local.

    Raises RecordError for XML that is malformed or unsafe, or has another root element.
    """
    root = parse_xml(path)
    if root.tag not in ("gama-local", "gama-xml"):
        raise RecordError(f"the root is <{safe_excerpt(root.tag)}>, expected <gama-local>", file=path)
    network = GamaNetwork(path)
    _replace_slashes(root, network)
    for node in root.descendants("network", "description", "parameters"):
        if node.tag == "network":
            _read_axes(node, network)
        elif node.tag == "description":
            network.title = single_line_title(node.text)
        else:
            _read_parameters(node, network)
    for section in root.descendants("points-observations"):
        network.default_sigmas |= {
            k.removesuffix("-stdev"): v for k, v in section.element.attrib.items() if k[-6:] == "-stdev"
        }
        for node in section:
            _read_element(node, network)
    return _make_recording(network)


def _replace_slashes(root: XmlNode, network: GamaNetwork) -> None:
    """Replacement, in place, of `/` in names of points by `_`, except in names that are refused in any case."""
    attributes = [(node, key) for node in root.element.iter() for key in POINT_NAME_ATTRIBUTES if key in node.attrib]
    used_names = dict.fromkeys(element.attrib[key] for element, key in attributes)
    names: dict[str, str] = {}
    for name in [name for name in used_names if "/" in name and ".." not in name]:
        new_name = name.replace("/", "_")
        while new_name in used_names and len(new_name) <= MAX_RECORDING_NAME_LENGTH:
            new_name += "_"
        if new_name not in used_names:
            names[name] = new_name
            used_names[new_name] = None
    for element, key in attributes:
        element.attrib[key] = names.get(element.attrib[key], element.attrib[key])
    if names:
        network.notes.append(f"'/' in names of points is written '_': {names_text([*names.values()], 3)}")


def _read_axes(node: XmlNode, network: GamaNetwork) -> None:
    axes, angles = node.attribute("axes-xy", "ne"), node.attribute("angles", "left-handed")
    if axes not in (*MIRRORED_AXES, *UNMIRRORED_AXES) or angles not in ("left-handed", "right-handed"):
        message = (
            f"axes-xy='{safe_excerpt(axes)}', angles='{safe_excerpt(angles)}' is not a coordinate system of gama-local"
        )
        raise node.location.error(message)
    network.y_sign = -1.0 if axes in MIRRORED_AXES else 1.0
    network.angle_sign = -1.0 if angles == "left-handed" else 1.0
    network.north_direction_deg = {"n": 0.0, "e": 90.0, "s": 180.0, "w": -90.0}[axes[0]]
    if network.y_sign < 0:
        network.notes.append(f"axes-xy='{axes}' is a left-handed system: the sign of y is changed")


def _read_parameters(node: XmlNode, network: GamaNetwork) -> None:
    """Addition of the content of ``<parameters>`` to `network`: a-priori sigma, and notes on unused parameters."""
    network.apriori_sigma = node.read_number("sigma-apr", network.apriori_sigma)
    if "sigma-apr" in node:
        apriori_sigma = safe_excerpt(node.attribute("sigma-apr"))
        network.notes.append(
            f"sigma-apr is {apriori_sigma}: Gama reports a sigma0 that is {apriori_sigma} times the one of ltsim"
        )
    if "latitude" in node or "ellipsoid" in node:
        network.notes.append("latitude and ellipsoid are not used: observations are not reduced to an ellipsoid")


def _read_element(node: XmlNode, network: GamaNetwork) -> None:
    if node.tag == "point":
        _read_point(node, network)
    elif node.tag == "obs":
        _read_observation_block(node, network)
    elif node.tag == "coordinates":
        _read_coordinates(node, network)
    elif node.tag in ("height-differences", "vectors"):
        differences, correlated = read_differences(node, network.y_sign, network.apriori_sigma)
        network.differences += differences
        network.notes += [IGNORED_DIFFERENCE_CORRELATIONS_NOTE] * correlated
    else:
        network.n_skipped_by_element[node.tag] += 1


def _read_point(node: XmlNode, network: GamaNetwork) -> GamaPoint:
    """Point that an XML element declares, also added to `network`: known along fixed axes, approximate along others.

    Capital letters in the attribute ``adj`` are the axes along which the point defines the datum.
    """
    name = node.read_name("id", "point")
    point = network.points.setdefault(name, GamaPoint())
    sign = {"x": 1.0, "y": network.y_sign, "z": 1.0}
    point.coordinates_by_axis.update({axis: sign[axis] * node.read_number(axis) for axis in "xyz" if axis in node})
    fixed, adjusted = node.attribute("fix"), node.attribute("adj")
    for word in (fixed, adjusted):
        if word.lower() not in ("", "xyz", "xy", "z"):
            raise node.location.error(f"point {name}: '{safe_excerpt(word)}' is not one of xyz, xy, z")
    if any(axis not in point.coordinates_by_axis for axis in fixed.lower()):
        raise node.location.error(f"point {name} is fixed, but lacks coordinates")
    point.fixed_axes = "".join(sorted({*point.fixed_axes, *fixed.lower()}))
    point.datum_axes = _named_axes(point.datum_axes + "".join(filter(str.isupper, adjusted)))
    point.active_axes = _named_axes(point.active_axes + fixed + adjusted)
    return point


def _named_axes(letters: str) -> str:
    """Axes among x, y and z, in this order, whose letters (small or capital) are in a text."""
    return "".join(axis for axis in "xyz" if axis in letters.lower())


def _read_coordinates(node: XmlNode, network: GamaNetwork) -> None:
    """Addition of observed coordinates and their covariance to `network`; correlations between points are ignored."""
    row, column, numbers = covariance_entries(node)
    sign, next_row = np.array([1.0, network.y_sign, 1.0]), 0
    for child in [child for child in node if child.tag == "point"]:
        point, axes = _read_point(child, network), [i for i, axis in enumerate("xyz") if axis in child]
        first_row, next_row = next_row, next_row + len(axes)
        of_point = slice(*np.searchsorted(row, [first_row, next_row]).tolist())
        is_in_block = column[of_point] < next_row
        rows_and_columns = np.stack([row[of_point], column[of_point]])[:, is_in_block] - first_row
        covariance, (i, j) = np.eye(3), np.array(axes, dtype=np.int64)[rows_and_columns]
        covariance[i, j] = covariance[j, i] = numbers[of_point][is_in_block]
        variances = np.diag(covariance)[axes]
        if np.count_nonzero(i == j) < len(axes) or not np.all(variances > 0):
            raise child.location.error("an observed coordinate has no positive variance, expected one for each")
        if np.any(numbers[of_point][~is_in_block]):
            network.notes.append(IGNORED_POINT_CORRELATIONS_NOTE)
        point.fixed_axes = "".join("xyz"[axis] for axis in axes)
        point.sigma_mm = float(np.sqrt(np.mean(variances)))
        if np.any(np.triu(covariance, 1)) or max(variances) > 1.0001 * min(variances):
            point.covariance_mm2 = tuple((covariance * np.outer(sign, sign))[np.triu_indices(3)].tolist())


def _read_observation_block(block: XmlNode, network: GamaNetwork) -> None:
    """Addition of the observations in an element ``<obs>`` (`block`) to `network`."""
    children = [child for child in block if child.tag != "cov-mat"]
    row, column, numbers = covariance_entries(block)
    if len(numbers) and row[-1] + 1 != len(children):
        raise block.location.error("the size of <cov-mat> does not match its observations")
    sigmas, shared_effects = [NOT_MEASURED] * len(children), np.zeros((len(children), 0))
    if len(numbers):
        independent, shared_effects = split_correlations(block, (row, column, numbers), network.n_shared_errors)
        sigmas = independent.tolist()
    shared = [
        {f"{network.n_shared_errors + k}": errors[k] for k in np.flatnonzero(errors)} for errors in shared_effects
    ]
    network.n_shared_errors += shared_effects.shape[1]
    circles = {(_standpoint(child, block), child.tag) for child in children if child.tag in ("direction", "azimuth")}
    names = {circle: network.setup_name(circle[0], with_directions=True) for circle in sorted(circles, reverse=True)}
    network.oriented_setups |= {name for (_, kind), name in names.items() if kind == "azimuth"}
    for child, sigma, errors in zip(children, sigmas, shared, strict=True):
        if child.tag in STDEV_ATTRIBUTE_PREFIXES:
            point = _standpoint(child, block)
            station = names.get((point, child.tag)) or names.get((point, "direction")) or network.setup_name(point)
            network.observations.append(_parse_observation(child, block, station, (sigma, errors), network))
        elif child.tag == "angle":
            _read_angle(child, block, (sigma, errors), network)
        else:
            network.n_skipped_by_element[child.tag] += 1


def _standpoint(child: XmlNode, block: XmlNode) -> str:
    """Name of the point from which the observation `child` of the element `block` was made; raises RecordError."""
    return (child if "from" in child else block).read_name("from", "point")


def _parse_observation(
    child: XmlNode, block: XmlNode, station: str, sigma_and_errors: SigmaAndSharedErrors, network: GamaNetwork
) -> SingleObservation:
    target = child.read_name("to", "point")
    heights = child.read_number("from_dh", block.read_number("from_dh", 0.0)), child.read_number("to_dh", 0.0)
    if child.tag in ("s-distance", "distance"):
        value = child.read_number("val")
        if not 0 < value < 1e6:
            raise child.location.error(f"found {value:g}, expected a distance above 0", f"<{child.tag}> val")
        sigma, shared = _si_sigma_and_shared_errors(sigma_and_errors, MILLIMETRE, child, network, value)
        flat = child.tag == "distance"
        return SingleObservation("distance", station, target, value, sigma, *heights, flat, child.line, shared)
    value, second = _parse_angle(child)
    sense = network.angle_sign if child.tag in ("direction", "azimuth") else -1.0
    sigma, shared = _si_sigma_and_shared_errors(sigma_and_errors, sense * second, child, network)
    if child.tag in ("direction", "azimuth"):
        return SingleObservation(
            "azimuth", station, target, sense * value, sigma, line=child.line, shared_error_shifts=shared
        )
    if value > np.pi:
        raise child.location.error(
            "found a zenith angle beyond half a circle, expected 0 to half a circle", "<z-angle> val"
        )
    return SingleObservation(
        "elevation", station, target, np.pi / 2 - value, sigma, *heights, line=child.line, shared_error_shifts=shared
    )


def _read_angle(child: XmlNode, block: XmlNode, sigma_and_errors: SigmaAndSharedErrors, network: GamaNetwork) -> None:
    """Addition of an angle as two directions of a separate set-up, each with the sigma of the angle over sqrt(2)."""
    station = network.setup_name(_standpoint(child, block), with_directions=True)
    value, second = _parse_angle(child)
    sigma, shared = _si_sigma_and_shared_errors(sigma_and_errors, network.angle_sign * second, child, network)
    for name, reading, errors in (("bs", 0.0, {}), ("fs", network.angle_sign * value, shared)):
        target = child.read_name(name, "point")
        direction = SingleObservation(
            "azimuth", station, target, reading, sigma / np.sqrt(2), line=child.line, shared_error_shifts=errors
        )
        network.observations.append(direction)


def _si_sigma_and_shared_errors(
    sigma_and_errors: SigmaAndSharedErrors, unit: float, child: XmlNode, network: GamaNetwork, distance: float = 0.0
) -> tuple[float, dict[str, float]]:
    """Standard deviation [m, rad] of the independent error of an observation, and changes [m, rad] by shared errors.

    `sigma_and_errors` are these numbers in file units, which `unit` converts to SI (negative: reversed sense of an
    angle). NaN as standard deviation is replaced by the file's default for the `distance` [m].
    """
    sigma, shared = sigma_and_errors
    independent = sigma if np.isfinite(sigma) else _sigma_of_observation(child, network, distance)
    return independent * abs(unit), {name: error * unit for name, error in shared.items()}


def _parse_angle(child: XmlNode) -> tuple[float, float]:
    """Angle [rad] from gon or degrees-minutes-seconds, and the unit [rad] of its standard deviation in the file."""
    match = _SEXAGESIMAL_ANGLE_PATTERN.fullmatch(child.required_attribute("val"))
    if match is None:
        return child.read_number("val", limit=1e4) * GON, CENTESIMAL_SECOND
    degrees = float(match[2]) + float(match[3]) / 60 + float(match[4]) / 3600
    return (-degrees if match[1] == "-" else degrees) * DEGREE, ARCSECOND


def _sigma_of_observation(child: XmlNode, network: GamaNetwork, distance: float = 0.0) -> float:
    """Standard deviation [mm, cc] of an observation, from its attribute or from the default of the file.

    The default is written as ``a``, or as ``a b c`` for a + b D^c with the distance D in km. `distance` is in m. Raises
    RecordError.
    """
    kind = STDEV_ATTRIBUTE_PREFIXES.get(child.tag, child.tag)
    words = child.attribute("stdev", network.default_sigmas.get(kind, "")).split()
    if not 0 < len(words) < 4:
        message = (
            f"no standard deviation is given for <{safe_excerpt(child.tag)}>, expected one (stdev, or {kind}-stdev)"
        )
        raise child.location.error(message)
    coefficients = [child.location.parse_number(word, "stdev", limit=1e9) for word in words]
    a, b, c = [*coefficients, 0.0, 1.0][:3] if len(coefficients) == 1 else [*coefficients, 1.0][:3]
    sigma = a + (b * (distance / 1000) ** c if b else 0.0)
    if not 0 < sigma < 1e9:
        message = f"found a standard deviation of {sigma:g}, expected one above 0"
        raise child.location.error(message, f"<{safe_excerpt(child.tag)}>")
    return sigma


def _make_recording(network: GamaNetwork) -> Recording:
    drop_height_dependent_observations(network)
    gauge, observed = split_reference_lengths(network)
    pointings, instrument_heights, target_heights = separate_constant_heights(
        pointings_from_observations(observed, network.file.name)
    )
    reason = "are not read, because a recording cannot contain them"
    skipped = [f"{n} elements <{safe_excerpt(tag)}> {reason}" for tag, n in network.n_skipped_by_element.items()]
    if not pointings and network.differences:
        message = "contains height differences or vectors without pointings, expected readings of instruments too"
        raise RecordError(f"{message}; gama-local adjusts such a network", file=network.file)
    if not pointings and skipped:
        raise RecordError(f"the file contains no pointings, and {'; '.join(skipped)}", file=network.file)
    network.notes += skipped
    stations = {
        name: Station(
            levelled=True,
            levelling_sigma_arcsec=EXACT_LEVELLING_SIGMA_ARCSEC,
            over=network.point_of_station[name],
            position_mm=network.points.get(network.point_of_station[name], GamaPoint()).complete_coordinates,
            yaw_deg=network.north_direction_deg if name in network.oriented_setups else None,
            yaw_sigma_arcsec=EXACT_LEVELLING_SIGMA_ARCSEC if name in network.oriented_setups else None,
            instrument_height_mm=instrument_heights.get(name, 0.0),
        )
        for name in dict.fromkeys(p.station for p in pointings)
    }
    names = dict.fromkeys([*network.points, *target_heights])
    setup = Setup(
        title=network.title,
        air=NO_AIR_UNCERTAINTY,
        instrument=Instrument(noise=_default_noise(network), corrected=True),
        gauge=LengthGauge(distance=tuple(gauge)) if gauge else None,
        stations=stations,
        targets={n: _make_target(network.points.get(n, GamaPoint()), target_heights.get(n, 0.0)) for n in names},
        differences=tuple(differences_with_distinct_names(network.differences)),
    )
    recording = recording_from_pointings(pointings, setup, notes=list(dict.fromkeys(network.notes)), file=network.file)
    check_reference_difference_ends(recording, network.file)
    return recording


def _make_target(point: GamaPoint, height: float) -> Target:
    reference_keys = {
        "known_axes": point.fixed_axes,
        "known_sigma_mm": point.sigma_mm,
        "known_covariance_mm2": point.covariance_mm2,
    }
    return Target(
        known_mm=point.coordinates_or_zeros if point.fixed_axes else None,
        **reference_keys if point.fixed_axes else {},  # type: ignore[arg-type]
        plan_only=point.active_axes == "xy",
        approximate_mm=None if point.fixed_axes == "xyz" else point.complete_coordinates,
        datum=bool(point.datum_axes),
        datum_axes=point.datum_axes or "xyz",  # type: ignore[arg-type]
        height_mm=height,
    )


def _default_noise(network: GamaNetwork) -> Noise:
    """Noise with the default standard deviations of the file; those of single observations are in columns."""

    def default(kind: str, fallback: float) -> float:
        words = network.default_sigmas.get(kind, "").split()
        value = SourceLocation(network.file).parse_number(words[0], f"{kind}-stdev") if words else fallback
        return max(value, 1e-6)

    return Noise(
        distance_mm=default("distance", 1.0),
        distance_ppm=0.0,
        azimuth_arcsec=default("direction", 3.0) * CENTESIMAL_SECOND / ARCSECOND,
        elevation_arcsec=default("zenith-angle", 3.0) * CENTESIMAL_SECOND / ARCSECOND,
    )
