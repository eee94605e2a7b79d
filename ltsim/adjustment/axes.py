"""The hall's axes: a recording whose adjustment comes out in coordinates that a person names.

Coordinates of some targets, or three targets that span the axes, become the datum of the recording: state, covariances
and every result that follows stand in them, by inner constraints over these targets. The network's shape is not
touched.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.frame import misses
from ltsim.adjustment.start import initial_network
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError, RecordError, option
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.alignment import robust_align
from ltsim.physics.model.measurement import verticals
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.files import shown
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import LEAST_SIGMA, Axes, Target

CLEARLY = 10.0
"""Ratio of the median misses of stated coordinates and of their mirror image from which they are mirrored: right ones
miss by the noise, a mirror image by the size of the network."""
SHAPE = 0.05
"""Part of a network's size by which stated coordinates may miss it, as drawings do, and still be of this network."""
NOTHING: Mapping[str, Axes] = MappingProxyType({})


def in_axes_of_points(recording: Recording, points: Mapping[str, Floats], source: str) -> Recording:
    """The recording with its datum at stated coordinates [m] of targets; `adjust` leaves out those that do not fit.

    RecordError when fewer than three targets off one line are among them, or their shape is not that of the network:
    mirrored, of another scale, or known points define the frame already.
    """
    common = [name for name in recording.targets if name in points and np.isfinite(points[name]).all()]
    _require_free_frame(recording, source)
    if len(common) < 3:
        message = f"holds {len(common)} of the recording's targets, expected three off one line or more"
        raise RecordError(message, file=source)
    (_, _, reached), _ = initial_network(recording)
    here = reached[[recording.targets.index(name) for name in common]]
    there = np.array([points[name] for name in common])
    _check_shape(here, there, source)
    if recording.setup.curved:
        recording = _with_verticals(recording, common, there)
    return _with_datum(recording, {name: points[name] for name in common}, source=source)


def _with_verticals(recording: Recording, names: Sequence[str], there: Floats) -> Recording:
    """The recording with the plumb lines of a sphere at its levelled stations in the axes of points `there` (k, 3) [m].

    A plumb line says nothing of the axes of coordinates that stand anywhere on the sphere: the adjusted network, turned
    to the points, says how its plumb lines lie there.
    """
    adjusted = adjust(recording)
    at = np.array([recording.targets.index(name) for name in names])
    determined = ~np.isin(np.array(names), adjusted.undetermined_targets)
    turn, _ = robust_align(adjusted.state.points[at[determined]], there[determined])
    lines = verticals(adjusted.recording) @ turn.T
    stations = dict(recording.setup.stations)
    for name, line in zip(recording.stations, lines.tolist(), strict=True):
        station = recording.station_setup(name)
        if station.levelled and station.vertical is None:
            stations[name] = station.model_copy(update={"vertical": tuple(line)})
    return recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))


def in_axes_of_three(recording: Recording, origin: str, x_axis: str, xy_plane: str) -> Recording:
    """The recording in axes that three targets span: the origin, one on the x axis, one in the plane of x and y.

    Raises
    ------
    RecordError
        When a target was not measured, or the three lie on one line.
    NetworkError
        When the recording cannot be adjusted.
    """
    three = (origin, x_axis, xy_plane)
    for name in three:
        if name not in recording.targets:
            raise RecordError(f"the axes name the target '{shown(name)}', which was never measured")
    _require_free_frame(recording)
    a, b, c = adjust(recording).state.points[[recording.targets.index(name) for name in three]]
    along, across = b - a, c - a
    length = float(np.linalg.norm(along))
    ahead = float(across @ along) / length if length else 0.0
    aside = float(np.linalg.norm(np.cross(along, across))) / length if length else 0.0
    if aside < 1e-3 * max(length, 1e-3):
        raise RecordError(f"the targets {', '.join(three)} of the axes lie on one line, expected three off it")
    places = {origin: np.zeros(3), x_axis: np.array([length, 0, 0]), xy_plane: np.array([ahead, aside, 0.0])}
    held: dict[str, Axes] = {origin: "xyz", x_axis: "yz", xy_plane: "z"}
    framed = _with_datum(recording, places, held)
    note = f"coordinates in the axes of {origin}, {x_axis} and {xy_plane}"
    return framed.replace(notes=(*framed.notes, note))


def with_control(recording: Recording, path: Path) -> Recording:
    """The recording with the coordinates of a list as known ones, each with its standard deviation.

    A list as of `read_points` with standard deviations; a coordinate that it leaves out is not known.

    RecordError for a malformed file, one without standard deviations, or one that names no measured target.
    """
    listed, targets, count = read_points(path, strict=False), dict(recording.setup.targets), 0
    for name, place, covariance, line in zip(listed.names, listed.points, listed.covariance, listed.lines, strict=True):
        is_given = np.isfinite(place)
        if name not in recording.targets or not is_given.any():
            continue
        spread = np.where(np.outer(is_given, is_given), covariance, np.eye(3)) / MILLIMETRE**2
        if not (np.isfinite(spread).all() and np.sqrt(np.diag(spread)).min() >= LEAST_SIGMA):
            message = f"states no standard deviation of {shown(name)}; add a column sigma_mm, or sigma_x_mm and so on"
            raise RecordError(f"{message}; coordinates without weight go with --frame", file=path, row=line)
        update = {
            "known_mm": tuple((np.nan_to_num(place) / MILLIMETRE).tolist()),
            "known_axes": "".join(axis for axis, is_given_axis in zip("xyz", is_given, strict=True) if is_given_axis),
            "known_covariance_mm2": tuple(spread[np.triu_indices(3)].tolist()),
        }
        targets[name] = targets.get(name, Target()).model_copy(update=update)
        count += 1
    if not count:
        raise RecordError("names none of the recording's targets; names must be written alike", file=path)
    note = f"{count} control points of {path.name}, each with its standard deviation"
    setup = recording.setup.model_copy(update={"targets": targets})
    return recording.replace(setup=setup, notes=(*recording.notes, *listed.notes, note))


def _require_free_frame(recording: Recording, source: str | None = None) -> None:
    if any(recording.target_setup(name).known_mm is not None for name in recording.targets):
        message = f"the recording's known points define the axes already: leave {option('frame')} out"
        raise RecordError(message, file=source)


def _check_shape(here: Floats, there: Floats, source: str) -> None:
    """Refuse coordinates (k, 3) on a line, of another scale or handedness than the network `here`."""
    mirror = here * [1.0, 1.0, -1.0]
    try:
        motions = robust_align(here, there), robust_align(mirror, there)
    except NetworkError:
        raise RecordError("its targets lie on one line, expected three off it or more", file=source) from None
    typical = float(np.median(misses(here, there, motions[0])))
    is_mirrored = float(np.median(misses(mirror, there, motions[1]))) * CLEARLY < typical
    pairs = np.triu_indices(len(here), 1)
    lengths, declared = (np.linalg.norm(p[pairs[0]] - p[pairs[1]], axis=1) for p in (here, there))
    if typical < SHAPE * float(np.median(lengths)) and not is_mirrored:
        return
    scale = float(np.median(declared / np.maximum(lengths, 1e-9)))
    if abs(scale - 1.0) > SHAPE:
        message = f"its targets lie {scale:.4g} times as far apart as they were measured, expected millimetres"
        raise RecordError(message, file=source)
    why = "they are left-handed" if is_mirrored else "is it another hall, or other names?"
    message = f"its coordinates do not fit the network by {typical / MILLIMETRE:.3g} mm in the median: {why}"
    raise RecordError(message, file=source)


def _with_datum(
    recording: Recording, places: Mapping[str, Floats], held: Mapping[str, Axes] = NOTHING, source: str | None = None
) -> Recording:
    """The recording with its datum at these places, each along the axes of `held` (default all)."""
    targets = {name: setup.model_copy(update={"datum": False}) for name, setup in recording.setup.targets.items()}
    for name, place in places.items():
        x, y, z = (place / MILLIMETRE).tolist()
        update = {"approximate_mm": (x, y, z), "datum": True, "datum_axes": held.get(name, "xyz")}
        targets[name] = targets.get(name, Target()).model_copy(update=update)
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets, "axes": source}))
