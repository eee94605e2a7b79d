"""Axes of the hall: recordings whose adjusted coordinates refer to axes that the user defines.

The axes are defined by declared coordinates of some targets, or by three targets (origin, x axis, xy plane). These
targets become the datum of the recording by inner constraints. The shape of the network does not change.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.frame import alignment_distances
from ltsim.adjustment.level_surface import N_PLANE_COEFFICIENTS, levelled_heights_notes
from ltsim.adjustment.significance import MIN_MISFIT_RATIO, SINGLE_TEST_LEVEL
from ltsim.adjustment.start import initial_network
from ltsim.core.arrays import Floats
from ltsim.core.errors import LtsimError, NetworkError, RecordError, option_text
from ltsim.core.notation import count_text, names_text
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE, align_robustly
from ltsim.physics.model.measurement import plumb_directions
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import MIN_SIGMA, Axes, Target

MAX_RELATIVE_POINT_MISCLOSURE = 0.05
"""Largest median misclosure of declared coordinates that define the axes, divided by the median distance between the
points. Nominal coordinates of a drawing differ less from a network. Declared coordinates whose scale differs from the
network by more than this fraction are rejected too.
"""
ALL_AXES_OF_EVERY_TARGET: Mapping[str, Axes] = MappingProxyType({})
"""Default of the axes in which each target defines the datum: an empty mapping, for all three axes of every target."""


def with_axes_from_points(recording: Recording, points_by_target: Mapping[str, Floats], source_text: str) -> Recording:
    """Recording whose axes (datum) are defined by declared coordinates (3,) [m] of targets, `points_by_target`.

    `adjust` later excludes declared coordinates that contradict those of the other targets. `source_text` is the name
    of their file. Raises RecordError if fewer than three targets have coordinates or they are collinear, if the
    declared points are mirrored or have another scale than the network, and if known points already define the frame.
    """
    common_names = [
        name for name in recording.targets if name in points_by_target and np.isfinite(points_by_target[name]).all()
    ]
    _require_free_frame(recording, source_text)
    if len(common_names) < 3:
        message = (
            f"contains {len(common_names)} of the recording's targets, expected at least three that are not on one line"
        )
        raise RecordError(message, file=source_text)
    (_, _, reached), _ = initial_network(recording)
    network_points = reached[[recording.targets.index(name) for name in common_names]]
    declared_points = np.array([points_by_target[name] for name in common_names])
    _require_same_shape(network_points, declared_points, source_text)
    notes = unmeasured_points_notes(
        [name for name in points_by_target if name not in recording.targets], Path(source_text).name
    )
    points = {name: points_by_target[name] for name in common_names}
    if recording.setup.curved:
        adjustment = adjust(recording)
        notes += levelled_heights_notes(adjustment, points, Path(source_text).name)
        recording = _with_plumb_lines(recording, adjustment, points)
    recording = recording.replace(notes=(*recording.notes, *notes))
    return _with_datum_points(recording, points, source=source_text)


def scale_error_of_declared_axes(adjustment: Adjustment) -> tuple[float, float] | None:
    """Relative scale error of the coordinates that define the axes of the hall, and its standard deviation.

    The scale error is the scale of the coordinates minus that of the measured ranges, estimated from the residuals of
    the coordinates. Its variance is the sum of that by the scatter of the residuals and that of the scale of the
    network, which depends on estimated constants such as the range zero. The result is None if the scale error is not
    significant, or if fewer than three points are tested.
    """
    used_tests = [test for test in adjustment.axes_point_tests if not test.is_excluded and len(test.residual) == 3]
    if len(used_tests) < MIN_POINTS_FOR_POSE:
        return None
    indices = [adjustment.recording.targets.index(test.name) for test in used_tests]
    places = adjustment.state.target_points[indices]
    column = (places - places.mean(axis=0)).ravel()
    residuals = np.array([test.residual for test in used_tests])
    residual = (residuals - residuals.mean(axis=0)).ravel()
    scale = float(column @ residual / (column @ column))
    dof = residual.size - 7  # six motions and the scale
    variance = float(np.sum((residual - scale * column) ** 2)) / dof
    weights = np.zeros((adjustment.problem.unknowns.n_columns, 1))
    weights[adjustment.problem.unknowns.target_columns[indices].ravel(), 0] = column / (column @ column)
    network_variance = float(weights[:, 0] @ adjustment.factorised_normals.multiply_by_covariance(weights)[:, 0])
    scale_variance = variance / float(column @ column) + network_variance
    if special.fdtrc(1, dof, scale**2 / max(scale_variance, np.finfo(float).tiny)) > SINGLE_TEST_LEVEL:
        return None
    return scale, float(np.sqrt(scale_variance))


def _with_plumb_lines(
    recording: Recording, adjustment: Adjustment, points_by_target: Mapping[str, Floats]
) -> Recording:
    """Recording in which the directions of the plumb lines at levelled stations are declared, for a curved earth.

    The directions refer to the axes of the declared points `points_by_target` (3,) [m], in which z need not be
    vertical. They are computed from the `adjustment` of the recording after its alignment to these points.
    """
    names = [name for name in points_by_target if name not in adjustment.undetermined_targets]
    indices = [recording.targets.index(name) for name in names]
    declared_points = np.array([points_by_target[name] for name in names])
    turn, _ = align_robustly(adjustment.state.target_points[indices], declared_points)
    lines = plumb_directions(adjustment.recording) @ turn.T
    stations = dict(recording.setup.stations)
    for name, line in zip(recording.stations, lines.tolist(), strict=True):
        station = recording.station_setup(name)
        if station.levelled and station.vertical is None:
            stations[name] = station.model_copy(update={"vertical": tuple(line)})
    return recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))


def with_axes_from_three_targets(
    recording: Recording, origin_target: str, x_axis_target: str, xy_plane_target: str
) -> Recording:
    """Recording whose axes (datum) are defined by three targets: origin, point on the x axis, point in the xy plane.

    Raises
    ------
    RecordError
        When a target was not measured, or the three targets lie on one line.
    NetworkError
        When the recording cannot be adjusted.
    """
    axis_names = (origin_target, x_axis_target, xy_plane_target)
    for name in axis_names:
        if name not in recording.targets:
            raise RecordError(f"the axes name the target '{safe_excerpt(name)}', which was never measured")
    _require_free_frame(recording)
    a, b, c = adjust(recording).state.target_points[[recording.targets.index(name) for name in axis_names]]
    along, across = b - a, c - a
    distance = float(np.linalg.norm(along))
    cosine = float(across @ along) / distance if distance else 0.0
    sine = float(np.linalg.norm(np.cross(along, across))) / distance if distance else 0.0
    if sine < 1e-3 * max(distance, 1e-3):
        raise RecordError(f"the targets {', '.join(axis_names)} of the axes lie on one line; name three that do not")
    places = {
        origin_target: np.zeros(3),
        x_axis_target: np.array([distance, 0, 0]),
        xy_plane_target: np.array([cosine, sine, 0.0]),
    }
    datum_axes: dict[str, Axes] = {origin_target: "xyz", x_axis_target: "yz", xy_plane_target: "z"}
    aligned = _with_datum_points(recording, places, datum_axes)
    note = f"coordinates in the axes of {origin_target}, {x_axis_target} and {xy_plane_target}"
    return aligned.replace(notes=(*aligned.notes, note))


def with_control_points(recording: Recording, path: Path) -> Recording:
    """Recording with the points in the file `path` as control points, weighted by their standard deviations.

    The file must contain standard deviations; a point may have fewer than three coordinates. Raises RecordError for a
    malformed file, for missing standard deviations, and for a file without measured targets.
    """
    listed, targets, count = read_points(path, refuses_contradictions=False), dict(recording.setup.targets), 0
    unmeasured_names = [name for name in listed.names if name not in recording.targets]
    for name, place, covariance, line in zip(
        listed.names, listed.points, listed.covariance, listed.line_numbers, strict=True
    ):
        is_given = np.isfinite(place)
        if name not in recording.targets or not is_given.any():
            continue
        spread = np.where(np.outer(is_given, is_given), covariance, np.eye(3)) / MILLIMETRE**2
        if not (np.isfinite(spread).all() and np.sqrt(np.diag(spread)).min() >= MIN_SIGMA):
            message = (
                f"has no standard deviation of {safe_excerpt(name)}; add a column sigma_mm, or sigma_x_mm and so on"
            )
            raise RecordError(f"{message}; use --frame for coordinates that only define the axes", file=path, row=line)
        update = {
            "known_mm": tuple((np.nan_to_num(place) / MILLIMETRE).tolist()),
            "known_axes": "".join(axis for axis, is_given_axis in zip("xyz", is_given, strict=True) if is_given_axis),
            "known_covariance_mm2": tuple(spread[np.triu_indices(3)].tolist()),
        }
        targets[name] = targets.get(name, Target()).model_copy(update=update)
        count += 1
    if not count:
        raise RecordError("the file contains none of the recording's targets; the spelling must be the same", file=path)
    notes = [f"{count_text(count, 'control point')} of {path.name}, each with its standard deviation"]
    notes += unmeasured_points_notes(unmeasured_names, path.name)
    setup = recording.setup.model_copy(update={"targets": targets})
    return recording.replace(setup=setup, notes=(*recording.notes, *listed.notes, *notes))


def with_levelled_control_note(recording: Recording, source_text: str) -> Recording:
    """Recording with a note if its control points have heights above a level surface and it models a curved earth.

    `source_text` is the name of the file with the control points. The recording is unchanged if the network without the
    control points cannot be adjusted.
    """
    setup_by_name = {name: recording.target_setup(name) for name in recording.targets}
    points = {
        name: np.array(target.known_mm) * MILLIMETRE
        for name, target in setup_by_name.items()
        if target.known_mm is not None and target.known_axes == "xyz"
    }
    if not recording.setup.curved or len(points) <= N_PLANE_COEFFICIENTS + 1:  # none of the heights would be redundant
        return recording
    unknown = {"known_mm": None, "known_covariance_mm2": None}
    targets = {**recording.setup.targets, **{name: setup_by_name[name].model_copy(update=unknown) for name in points}}
    free = recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))
    try:
        notes = levelled_heights_notes(adjust(free), points, source_text)
    except LtsimError:
        return recording
    return recording.replace(notes=(*recording.notes, *notes))


def unmeasured_points_notes(names: Sequence[str], source_text: str) -> list[str]:
    """Note on points of a file that no pointing measures and that are not used; an empty list without such points.

    `names` are the names of these points, and `source_text` is the name of their file.
    """
    if not names:
        return []
    verb = "is" if len(names) == 1 else "are"
    return [
        f"{count_text(len(names), 'point')} of {source_text} {verb} not used, because no pointing measures "
        f"{'it' if len(names) == 1 else 'them'}: {names_text(names)}; if the recording has other names for "
        f"{'it' if len(names) == 1 else 'them'}, make the names equal"
    ]


def _require_free_frame(recording: Recording, source: str | None = None) -> None:
    """Check that no known points already define the axes; raises RecordError with the file name `source`."""
    if any(recording.target_setup(name).known_mm is not None for name in recording.targets):
        message = f"the known points of the recording already define the axes: leave {option_text('frame')} out"
        raise RecordError(message, file=source)


def _require_same_shape(network_points: Floats, declared_points: Floats, source: str) -> None:
    """Check that k declared points (k, 3) [m] have the shape of the network points (k, 3) [m]; raises RecordError.

    Declared points are rejected if they are collinear, mirrored, in another scale, or far from the network points after
    alignment. `source` is the file name in the error.
    """
    mirror = network_points * [1.0, 1.0, -1.0]
    try:
        motions = align_robustly(network_points, declared_points), align_robustly(mirror, declared_points)
    except NetworkError:
        raise RecordError("the targets lie on one line, expected at least three that do not", file=source) from None
    typical = float(np.median(alignment_distances(network_points, declared_points, motions[0])))
    is_mirrored = (
        float(np.median(alignment_distances(mirror, declared_points, motions[1]))) * MIN_MISFIT_RATIO < typical
    )
    point_pairs = np.triu_indices(len(network_points), 1)
    lengths, declared = (
        np.linalg.norm(p[point_pairs[0]] - p[point_pairs[1]], axis=1) for p in (network_points, declared_points)
    )
    if typical < MAX_RELATIVE_POINT_MISCLOSURE * float(np.median(lengths)) and not is_mirrored:
        return
    scale = float(np.median(declared / np.maximum(lengths, 1e-9)))
    if abs(scale - 1.0) > MAX_RELATIVE_POINT_MISCLOSURE:
        message = f"the distances between its targets are {scale:.4g} times the measured ones"
        message += "; give its coordinates in millimetres"
        raise RecordError(message, file=source)
    reason = "its axes are left-handed" if is_mirrored else "check that hall and target names are the right ones"
    message = f"its coordinates differ from the network by {typical / MILLIMETRE:.3g} mm in the median: {reason}"
    raise RecordError(message, file=source)


def _with_datum_points(
    recording: Recording,
    points_by_target: Mapping[str, Floats],
    axes_by_target: Mapping[str, Axes] = ALL_AXES_OF_EVERY_TARGET,
    source: str | None = None,
) -> Recording:
    """Recording whose axes (datum) are defined by the positions of some targets, `points_by_target` (3,) [m].

    `axes_by_target` restricts the datum to some coordinates of a target; `source` is the name of the file with the
    positions.
    """
    targets = {name: setup.model_copy(update={"datum": False}) for name, setup in recording.setup.targets.items()}
    for name, place in points_by_target.items():
        x, y, z = (place / MILLIMETRE).tolist()
        update = {"approximate_mm": (x, y, z), "datum": True, "datum_axes": axes_by_target.get(name, "xyz")}
        targets[name] = targets.get(name, Target()).model_copy(update=update)
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets, "datum_source": source}))
