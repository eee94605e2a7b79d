"""The hall's axes: a recording whose adjustment comes out in coordinates that a person names.

Coordinates of some targets, or three targets that span the axes, become the datum of the recording: state, covariances
and every result that follows stand in them, by inner constraints over these targets. The network's shape is not
touched.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.start import reached_network
from ltsim.arrays import Floats
from ltsim.errors import NetworkError, RecordError
from ltsim.geometry.alignment import align, robust_align
from ltsim.recording.coordinates import read_points
from ltsim.recording.files import shown
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Axes, Target
from ltsim.units import MILLIMETRE

GROSS_MM = 2.0
CLEARLY = 10.0
SHAPE = 0.05
"""Part of a network's size by which stated coordinates may miss it, as drawings do, and still be of this network."""
MOST_NAMED = 4
NOTHING: Mapping[str, Axes] = MappingProxyType({})


def in_axes_of_points(recording: Recording, points: Mapping[str, Floats], source: str) -> Recording:
    """The recording with its datum at stated coordinates [m] of targets; those that do not fit are left out of it.

    Raises
    ------
    RecordError
        When fewer than three targets off one line are among them, or their shape is not that of the network:
        mirrored, of another scale, or known points define the frame already.
    """
    common = [name for name in recording.targets if name in points and np.isfinite(points[name]).all()]
    if any(recording.target_setup(name).known_mm is not None for name in recording.targets):
        raise RecordError("the recording's known points define the axes already: leave --frame out", file=source)
    if len(common) < 3:
        message = f"holds {len(common)} of the recording's targets, expected three off one line or more"
        raise RecordError(message, file=source)
    (_, _, reached), _ = reached_network(recording)
    here = reached[[recording.targets.index(name) for name in common]]
    there = np.array([points[name] for name in common])
    try:
        misses = _misses(here, there)
    except NetworkError:
        raise RecordError("its targets lie on one line, expected three off it or more", file=source) from None
    _check_shape(here, there, misses, source)
    limit = max(CLEARLY * float(np.median(misses)), GROSS_MM * MILLIMETRE)
    kept = [name for name, miss in zip(common, misses, strict=True) if miss <= limit]
    off = [f"{name} ({miss / MILLIMETRE:.3g} mm)" for name, miss in zip(common, misses, strict=True) if miss > limit]
    within = misses[misses <= limit].max() / MILLIMETRE
    said = f"coordinates in the axes of {source}: {len(kept)} targets fit it within {within:.3g} mm"
    if off:
        more = f" and {len(off) - MOST_NAMED} more" if len(off) > MOST_NAMED else ""
        said += f"; left out of the datum: {', '.join(off[:MOST_NAMED])}{more}"
    return _with_datum(recording, {name: points[name] for name in kept}, said)


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
    if any(recording.target_setup(name).known_mm is not None for name in recording.targets):
        raise RecordError("the recording's known points define the axes already: leave --frame out")
    a, b, c = adjust(recording).state.points[[recording.targets.index(name) for name in three]]
    along, across = b - a, c - a
    length = float(np.linalg.norm(along))
    ahead = float(across @ along) / length if length else 0.0
    aside = float(np.linalg.norm(np.cross(along, across))) / length if length else 0.0
    if aside < 1e-3 * max(length, 1e-3):
        raise RecordError(f"the targets {', '.join(three)} of the axes lie on one line, expected three off it")
    places = {origin: np.zeros(3), x_axis: np.array([length, 0, 0]), xy_plane: np.array([ahead, aside, 0.0])}
    held: dict[str, Axes] = {origin: "xyz", x_axis: "yz", xy_plane: "z"}
    return _with_datum(recording, places, f"coordinates in the axes of {origin}, {x_axis} and {xy_plane}", held)


def read_axes(path: Path) -> dict[str, Floats]:
    """Coordinates [m] by target of a list of any dialect, those that have all three; raises RecordError."""
    return read_points(path, strict=False).by_name


def _misses(here: Floats, there: Floats) -> Floats:
    """How far (k,) [m] points are from where they are stated after the motion that most of them ask for."""
    align(here, there)  # three off one line
    rotation, shift = robust_align(here, there)
    return np.asarray(np.linalg.norm(here @ rotation.T + shift - there, axis=1))


def _check_shape(here: Floats, there: Floats, misses: Floats, source: str) -> None:
    """Refuse coordinates of another scale or handedness."""
    pairs = np.triu_indices(len(here), 1)
    lengths, stated = (np.linalg.norm(p[pairs[0]] - p[pairs[1]], axis=1) for p in (here, there))
    scale = float(np.median(stated / np.maximum(lengths, 1e-9)))
    typical = float(np.median(misses))
    mirrored = float(np.median(_misses(here * [1.0, 1.0, -1.0], there)))
    is_mirrored = mirrored * CLEARLY < typical
    if typical < SHAPE * float(np.median(lengths)) and not is_mirrored:
        return
    if abs(scale - 1.0) > SHAPE:
        message = f"its targets lie {scale:.4g} times as far apart as they were measured, expected millimetres"
        raise RecordError(message, file=source)
    why = "they are left-handed" if is_mirrored else "is it another hall, or other names?"
    message = f"its coordinates do not fit the network by {typical / MILLIMETRE:.3g} mm in the median: {why}"
    raise RecordError(message, file=source)


def _with_datum(
    recording: Recording, places: Mapping[str, Floats], said: str, held: Mapping[str, Axes] = NOTHING
) -> Recording:
    """The recording with its datum at these places, each along the axes of `held` (default all)."""
    targets = {name: setup.model_copy(update={"datum": False}) for name, setup in recording.setup.targets.items()}
    for name, place in places.items():
        x, y, z = (place / MILLIMETRE).tolist()
        known = {"approximate_mm": (x, y, z), "datum": True, "datum_axes": held.get(name, "xyz")}
        targets[name] = targets.get(name, Target()).model_copy(update=known)
    setup = recording.setup.model_copy(update={"targets": targets})
    return recording.replace(setup=setup, notes=(*recording.notes, said))
