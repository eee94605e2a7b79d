"""Input files of GNU Gama (``gama-local``).

Understood are directions, zenith angles, slope and horizontal distances, angles, heights of instrument and target,
points that are fixed, constrained, adjusted or observed with a covariance. Each set of directions with an orientation
of its own becomes a set-up of its own over the same point; distances alone between two targets are known lengths.
What has no place in a recording (height differences, vectors, azimuths) is named in a note and left out.

Gama's instruments are levelled exactly and its angles count clockwise unless said otherwise; a left-handed system of
axes is made right-handed by turning y over, which a note says.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.errors import RecordError
from ltsim.recording.build import NAN, recording_of
from ltsim.recording.conventions import NO_HINTS, Hints
from ltsim.recording.files import MAX_TEXT, check_name, number, shown
from ltsim.recording.formats.xml import attribute, line_of, parse, tag, value_of
from ltsim.recording.merge import Merged, Observed, merged
from ltsim.recording.recording import Recording
from ltsim.recording.setup import EXACT_LEVEL_ARCSEC, Gauge, GaugeDistance, Instrument, Noise, Setup, Station, Target
from ltsim.units import ARCSECOND, DEGREE, FACTOR, GON, MILLIMETRE

LEFT_HANDED, RIGHT_HANDED = ("ne", "sw", "es", "wn"), ("en", "nw", "se", "ws")
FIXED_MM = 1e-4
CC = FACTOR["cc"]
_DMS = re.compile(r"([+-]?)(\d{1,3})-(\d{1,2})-(\d{1,2}(?:\.\d+)?)", re.ASCII)

CORRELATIONS = "correlations of observations are left out: of a <cov-mat> the diagonal is used"


@dataclass
class _Network:
    """What is gathered while walking through the file."""

    file: Path
    y_sign: float = 1.0
    angle_sign: float = -1.0
    stdev: dict[str, str] = field(default_factory=dict)
    targets: dict[str, dict[str, Any]] = field(default_factory=dict)
    sets: dict[str, int] = field(default_factory=dict)
    over: dict[str, str] = field(default_factory=dict)
    observed: list[Observed] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def leave_out(self, what: str) -> None:
        self.left_out[what] = self.left_out.get(what, 0) + 1

    def station(self, point: str, *, with_directions: bool) -> str:
        """Name of the set-up over a point; further sets of directions get further set-ups."""
        if with_directions:
            self.sets[point] = self.sets.get(point, 0) + 1
        count = self.sets.get(point, 1)
        name = point if count == 1 else f"{point}#{count}"
        self.over[name] = point
        return name


def recognises(path: Path, head: str) -> bool:
    """Whether the root element is that of gama-local."""
    return re.search(r"<gama-(local|xml)\b", head) is not None and "<gama-local-adjustment" not in head


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Read an input file of gama-local; raises RecordError for XML that is malformed, hostile or not of this kind."""
    root = parse(path)
    if tag(root) not in ("gama-local", "gama-xml"):
        raise RecordError(f"the root is <{shown(tag(root))}>, expected <gama-local>", file=path)
    network = _Network(path)
    title = ""
    for element in root.iter():
        if tag(element) == "network":
            _read_axes(element, network)
        elif tag(element) == "description":
            title = " ".join((element.text or "").split())[:MAX_TEXT].replace("<", "(").replace(">", ")")
        elif tag(element) == "parameters":
            _read_parameters(element, network)
    for section in root.iter():
        if tag(section) == "points-observations":
            _read_section(section, network)
    return _finished(network, title)


def _read_axes(element: Element, network: _Network) -> None:
    axes, angles = element.get("axes-xy", "ne"), element.get("angles", "left-handed")
    if axes not in (*LEFT_HANDED, *RIGHT_HANDED) or angles not in ("left-handed", "right-handed"):
        message = f"axes-xy='{shown(axes)}', angles='{shown(angles)}' is no system that gama-local knows"
        raise RecordError(message, file=network.file)
    network.y_sign = -1.0 if axes in LEFT_HANDED else 1.0
    network.angle_sign = -1.0 if angles == "left-handed" else 1.0
    if network.y_sign < 0:
        network.notes.append(f"axes-xy='{axes}' is a left-handed system: y is turned over to make it right-handed")


def _read_parameters(element: Element, network: _Network) -> None:
    apriori = element.get("sigma-apr")
    if apriori is not None:
        network.notes.append(f"sigma-apr is {shown(apriori.strip())}: Gama's sigma0 is the one found here times that")
    if element.get("latitude") is not None or element.get("ellipsoid") is not None:
        network.notes.append("latitude and ellipsoid are not used: no reduction of observations to an ellipsoid")


def _read_section(section: Element, network: _Network) -> None:
    network.stdev |= {k.removesuffix("-stdev"): v for k, v in section.attrib.items() if k.endswith("-stdev")}
    for element in section:
        kind = tag(element)
        if kind == "point":
            _read_point(element, network)
        elif kind == "obs":
            _read_obs(element, network)
        elif kind == "coordinates":
            _read_coordinates(element, network)
        elif kind in ("height-differences", "vectors"):
            for inner in element:
                if tag(inner) != "cov-mat":
                    network.leave_out(tag(inner))
        else:
            network.leave_out(kind)


def _read_point(element: Element, network: _Network) -> None:
    """Coordinates as known (fixed) along some axes and approximate along the others; capitals define the datum."""
    file = network.file
    name = check_name(attribute(element, "id", file), "point", file=file)
    point = network.targets.setdefault(name, {})
    values = {axis: value_of(element, axis, file) for axis in "xyz" if element.get(axis) is not None}
    if "y" in values:
        values["y"] *= network.y_sign
    point.setdefault("values", {}).update(values)
    fixed, adjusted = element.get("fix", "").strip(), element.get("adj", "").strip()
    for word in (fixed, adjusted):
        if word.lower() not in ("", "xyz", "xy", "z"):
            raise RecordError(f"point {name}: '{shown(word)}' is not one of xyz, xy, z", file=file)
    if any(axis not in point["values"] for axis in fixed.lower()):
        raise RecordError(f"point {name} is fixed without all its coordinates", file=file)
    point["fixed"] = "".join(sorted({*point.get("fixed", ""), *fixed.lower()}))
    point["datum"] = point.get("datum", "") + "".join(letter.lower() for letter in adjusted if letter.isupper())
    point["active"] = "".join(axis for axis in "xyz" if axis in (point.get("active", "") + fixed + adjusted).lower())


def _read_coordinates(element: Element, network: _Network) -> None:
    """Observed coordinates: known with their covariance; what correlates different points is left out."""
    row, column, numbers = _covariances(element, network)
    at = 0
    for point in [inner for inner in element if tag(inner) == "point"]:
        axes = ["xyz".index(axis) for axis in "xyz" if point.get(axis) is not None]
        _read_point(point, network)
        own, at = np.eye(3), at + len(axes)
        mine = (row >= at - len(axes)) & (row < at)
        inside = mine & (column < at)
        place = np.array(axes)[np.stack([row[inside], column[inside]]) - at + len(axes)]
        own[place[0], place[1]] = own[place[1], place[0]] = numbers[inside]
        variances = np.diag(own)[axes]
        if np.count_nonzero(row[inside] == column[inside]) < len(axes) or not np.all(variances > 0):
            raise RecordError("observed coordinates need a variance each", file=network.file)
        if np.any(numbers[mine & ~inside]):
            network.notes.append(CORRELATIONS)
        entry = network.targets[attribute(point, "id", network.file)]
        entry["fixed"] = "".join("xyz"[axis] for axis in axes)
        entry["sigma"] = float(np.sqrt(np.mean(variances)))
        if np.any(np.triu(own, 1)) or max(variances) > 1.0001 * min(variances):
            sign = np.array([1.0, network.y_sign, 1.0])
            entry["covariance"] = tuple((own * np.outer(sign, sign))[np.triu_indices(3)].tolist())


def _covariances(element: Element, network: _Network) -> tuple[Ints, Ints, Floats]:
    """Row, column and value (k,) of the upper triangle of a matrix in Gama's band form, [mm^2] or [cc^2]."""
    matrix = next((inner for inner in element if tag(inner) == "cov-mat"), None)
    if matrix is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
    size, band = (int(value_of(matrix, name, network.file)) for name in ("dim", "band"))
    words = (matrix.text or "").split()
    in_row = np.array([min(band, size - 1 - i) + 1 for i in range(min(size, 100_000))], dtype=np.int64)
    if not 0 < size < 100_000 or not 0 <= band < size or len(words) != in_row.sum():
        raise RecordError("a <cov-mat> whose numbers do not match dim and band", file=network.file)
    row = np.repeat(np.arange(size), in_row)
    column = row + np.arange(len(row)) - np.repeat(np.cumsum(in_row) - in_row, in_row)
    return row, column, np.array([number(word, file=network.file, column="cov-mat") for word in words])


def _diagonal(element: Element, network: _Network) -> list[float]:
    """The variances of a covariance matrix, [mm^2] or [cc^2]."""
    row, column, numbers = _covariances(element, network)
    if np.any(numbers[row != column]):
        network.notes.append(CORRELATIONS)
    return [float(v) for v in numbers[row == column]]


def _read_obs(element: Element, network: _Network) -> None:
    """One block of observations from a point, or with ``from`` at every observation."""
    inner = [child for child in element if tag(child) != "cov-mat"]
    variances = _diagonal(element, network)
    if variances and len(variances) != len(inner):
        raise RecordError("a <cov-mat> that does not match its observations", file=network.file)
    directions = {_from(child, element, network) for child in inner if tag(child) == "direction"}
    names = {point: network.station(point, with_directions=True) for point in sorted(directions)}
    for i, child in enumerate(inner):
        sigma = float(np.sqrt(variances[i])) if variances else NAN
        kind = tag(child)
        if kind in ("direction", "z-angle", "s-distance", "distance"):
            point = _from(child, element, network)
            station = names.get(point) or network.station(point, with_directions=False)
            network.observed.append(_observation(child, element, station, sigma, network))
        elif kind == "angle":
            _read_angle(child, element, sigma, network)
        else:
            network.leave_out(kind)


def _from(child: Element, block: Element, network: _Network) -> str:
    holder = child if child.get("from") is not None else block
    return check_name(attribute(holder, "from", network.file), "point", file=network.file)


def _observation(child: Element, block: Element, station: str, sigma: float, network: _Network) -> Observed:
    file, kind = network.file, tag(child)
    target = check_name(attribute(child, "to", file), "point", file=file)
    heights = (
        value_of(child, "from_dh", file, value_of(block, "from_dh", file, 0.0)),
        value_of(child, "to_dh", file, 0.0),
    )
    if kind in ("s-distance", "distance"):
        value = value_of(child, "val", file)
        if not 0 < value < 1e6:
            raise RecordError(f"found {value:g}, expected a distance above 0", file=file, column=f"<{kind}> val")
        stated = sigma if np.isfinite(sigma) else _stdev(child, "distance", network, value)
        flat, line = kind == "distance", line_of(child)
        return Observed("distance", station, target, value, stated * MILLIMETRE, *heights, horizontal=flat, line=line)
    value, second = _angle(attribute(child, "val", file), file, kind)
    name = "direction" if kind == "direction" else "zenith-angle"
    stated = (sigma if np.isfinite(sigma) else _stdev(child, name, network)) * second
    if kind == "direction":
        return Observed("azimuth", station, target, network.angle_sign * value, stated, line=line_of(child))
    if value > np.pi:
        raise RecordError("a zenith angle beyond half a circle", file=file, column="<z-angle> val")
    return Observed("elevation", station, target, np.pi / 2 - value, stated, *heights, line=line_of(child))


def _angle(text: str, file: Path, kind: str) -> tuple[float, float]:
    """Angle [rad] in gon or degrees-minutes-seconds, and the second [rad] its standard deviation is stated in."""
    parts = _DMS.fullmatch(text)
    if parts is None:
        return number(text, file=file, column=f"<{kind}> val", limit=1e4) * GON, CC
    degrees = float(parts.group(2)) + float(parts.group(3)) / 60 + float(parts.group(4)) / 3600
    return (-degrees if parts.group(1) == "-" else degrees) * DEGREE, ARCSECOND


def _stdev(child: Element, kind: str, network: _Network, distance: float = 0.0) -> float:
    """Standard deviation as stated for the observation, or by default: ``a``, or ``a b c`` = a + b D^c, D in km."""
    text = child.get("stdev", network.stdev.get(kind, ""))
    words = text.split()
    if not words or len(words) > 3:
        message = f"no standard deviation is stated for <{shown(tag(child))}>, expected one (stdev, or {kind}-stdev)"
        raise RecordError(message, file=network.file)
    a, b, c = ([number(w, file=network.file, column="stdev", limit=1e9) for w in words] + [0.0, 1.0][len(words) - 1 :])[
        :3
    ]
    sigma = a + (b * (distance / 1000) ** c if b else 0.0)
    if not 0 < sigma < 1e9:
        raise RecordError(f"a standard deviation of {sigma:g}", file=network.file, column=f"<{shown(tag(child))}>")
    return sigma


def _read_angle(child: Element, block: Element, sigma: float, network: _Network) -> None:
    """An angle is two directions with an orientation of their own, each with its sigma over the square root of 2."""
    file = network.file
    station = network.station(_from(child, block, network), with_directions=True)
    value, second = _angle(attribute(child, "val", file), file, "angle")
    stated = (sigma if np.isfinite(sigma) else _stdev(child, "angle", network)) * second / np.sqrt(2)
    for name, turned in (("bs", 0.0), ("fs", network.angle_sign * value)):
        target = check_name(attribute(child, name, file), "point", file=file)
        network.observed.append(Observed("azimuth", station, target, turned, stated, line=line_of(child)))


def _in_plan(network: _Network) -> None:
    """Leave out what concerns heights that are neither fixed nor adjusted, and hold those heights, as Gama does."""
    flat = {name for name, point in network.targets.items() if point.get("active") == "xy"}
    if not flat:
        return
    kept = []
    for o in network.observed:
        in_plan = bool({network.over[o.station], o.target} & flat)
        if in_plan and not (o.kind == "azimuth" or o.horizontal):
            continue
        kept.append(replace(o, instrument_height=0.0, target_height=0.0) if in_plan else o)
    for name in flat:
        network.targets[name]["values"].setdefault("z", 0.0)
        network.targets[name]["held"] = True
    network.notes.append(
        f'{len(flat)} points are adjusted in plan only (adj="xy"): they have no heights, and '
        f"{len(network.observed) - len(kept)} observations that need heights are left out, as Gama does"
    )
    network.observed = kept


def _finished(network: _Network, title: str) -> Recording:
    _in_plan(network)
    gauge, observed = _lengths(network)
    together = merged(observed, network.file.name)
    for what, count in network.left_out.items():
        network.notes.append(f"{count} <{shown(what)}> left out: a recording has no place for it")
    stations = {
        name: Station(
            levelled=True,
            levelling_sigma_arcsec=EXACT_LEVEL_ARCSEC,
            over=network.over[name],
            position_mm=_coordinates(network.targets.get(network.over[name], {})),
            instrument_height_mm=together.instrument_heights.get(name, 0.0),
        )
        for name in dict.fromkeys(p.station for p in together.pointings)
    }
    names = dict.fromkeys([*network.targets, *together.target_heights])
    setup = Setup(
        title=title,
        instrument=Instrument(noise=_noise(network), corrected=True),
        gauge=Gauge(distance=tuple(gauge)) if gauge else None,
        stations=stations,
        targets={name: _target(name, network, together) for name in names},
    )
    notes = list(dict.fromkeys(network.notes))
    return recording_of(together.pointings, setup, notes=notes, file=network.file)


def _lengths(network: _Network) -> tuple[list[GaugeDistance], list[Observed]]:
    """Slope distances from points where nothing else is measured, between marks that others see: known lengths."""
    angles = {o.station for o in network.observed if o.kind != "distance" or o.horizontal}
    seen = {o.target for o in network.observed if o.station in angles}
    gauge, rest = [], []
    for o in network.observed:
        ends = {network.over[o.station], o.target}
        at_marks = not o.instrument_height and not o.target_height
        if o.station not in angles and len(ends) == 2 and ends <= seen and at_marks:
            length, sigma = o.value / MILLIMETRE, o.sigma / MILLIMETRE
            start = network.over[o.station]
            line = {"from": start, "to": o.target, "length_mm": length, "sigma_mm": sigma}
            gauge.append(GaugeDistance.model_validate(line))
        else:
            rest.append(o)
    return gauge, rest


def _coordinates(point: dict[str, Any]) -> tuple[float, float, float] | None:
    values = point.get("values", {})
    if set(values) != {"x", "y", "z"}:
        return None
    x, y, z = (round(values[axis] / MILLIMETRE, 9) for axis in "xyz")
    return x, y, z


def _target(name: str, network: _Network, together: Merged) -> Target:
    point = network.targets.get(name, {})
    values, fixed = point.get("values", {}), point.get("fixed", "") + "z" * point.get("held", False)
    known = tuple(round(values.get(axis, 0.0) / MILLIMETRE, 9) for axis in "xyz") if fixed else None
    datum = "".join(axis for axis in "xyz" if axis in point.get("datum", ""))
    return Target(
        known_mm=known,
        known_axes=fixed or "xyz",
        known_sigma_mm=point.get("sigma", FIXED_MM) if fixed else Target().known_sigma_mm,
        known_covariance_mm2=point.get("covariance") if fixed else None,
        in_plan=point.get("held", False),
        approximate_mm=None if fixed == "xyz" else _coordinates(point),
        datum=bool(datum),
        datum_axes=datum or "xyz",  # type: ignore[arg-type]
        height_mm=together.target_heights.get(name, 0.0),
    )


def _noise(network: _Network) -> Noise:
    """The file's default standard deviations; those of single observations stand in columns."""

    def default(kind: str, otherwise: float) -> float:
        words = network.stdev.get(kind, "").split()
        return number(words[0], file=network.file, column=f"{kind}-stdev") if words else otherwise

    angle = CC / ARCSECOND
    return Noise(
        distance_mm=max(default("distance", 1.0), 1e-6),
        distance_ppm=0.0,
        azimuth_arcsec=max(default("direction", 3.0), 1e-6) * angle,
        elevation_arcsec=max(default("zenith-angle", 3.0), 1e-6) * angle,
    )
