"""Reference values (known points, lengths, levels) in an adjustment: misclosures and effects of errors on residuals."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.rows import ControlRows
from ltsim.core.arrays import Floats, Ints
from ltsim.core.units import MILLIMETRE
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import MIN_UNKNOWN_SCALE_SIGMA_PPM, common_expansion_per_k

ReferenceKind = Literal["point", "difference", "length", "level", "yaw", "mark", "axes", "scale"]
"""Kind of a reference value.

`point` known coordinates, `difference` known coordinate difference, `length` known length, `level` levelled station,
`yaw` known direction of azimuth zero, `mark` set-up over a mark, `axes` declared coordinates that only define the axes,
`scale` common scale of all known lengths.
"""
MIN_REFERENCE_TO_READING_SIGMA_RATIO = 0.3
"""Smallest standard deviation of a reference value during its test, divided by the median standard deviation of the
readings."""
STATION_UPDATES_REMOVING_REFERENCE: dict[str, dict[str, object]] = {
    "level": {"levelled": False, "yaw_sigma_arcsec": None},
    "yaw": {"yaw_sigma_arcsec": None},
    "mark": {"over": None},
}
"""Changes of a station's entries in `setup.toml` that remove a reference value, by kind of reference value."""


@dataclass(frozen=True)
class ReferenceValue:
    """Reference value with q components, for example a known point with three or a length with one."""

    kind: ReferenceKind
    """Kind of the reference value, such as `point`, `length` or `level`."""
    name: str
    """Name of the target or station, or names of both ends of a length or difference, such as `A-B`."""
    declared_axes: str
    """Axes of the declared coordinates of a point or difference, for example `xy`; empty for other kinds."""
    declared_sigmas: Floats
    """Declared standard deviations of the q components, (q,) [m, rad or 1]."""
    residual: Floats
    """Misclosures (q,) [m, rad or 1] of the q components: declared minus adjusted values."""
    occupied_by: str = field(default="", kw_only=True)
    """Name of the set-up over a known point that is not measured as a target; empty for other reference values."""
    expansion_per_k: float = field(default=0.0, kw_only=True)
    """Declared coefficient of thermal expansion [1/K] of all known lengths, for their scale; otherwise 0."""


@dataclass(frozen=True)
class ReferenceValueRows(ReferenceValue):
    """Reference value with its equations in an adjustment."""

    equation_indices: Ints
    """Indices (r,) of the r equations whose residuals an error of the reference value changes."""
    design_columns: Floats
    """Derivatives (r, q) of the whitened residuals of the r equations `equation_indices` with respect to errors of the
    q components."""


def reference_values(problem: NetworkProblem, state: NetworkState) -> Iterator[ReferenceValueRows]:
    """Reference values of an adjustment at a state, in the order of their equations, then set-ups over marks."""
    recording, first, gauge = problem.model.recording, int(problem.is_used_reading.sum()), problem.gauge_rows
    shown, gap = gauge.decorrelate(np.eye(len(gauge))), problem.length_residuals(state)
    for i in np.flatnonzero(np.isfinite(gauge.total_sigmas)).tolist():
        name = f"{recording.targets[gauge.first_targets[i]]}-{recording.targets[gauge.second_targets[i]]}"
        reached = np.flatnonzero(shown[:, i])
        column = shown[reached, i : i + 1]
        yield ReferenceValueRows(
            "length", name, "", gauge.total_sigmas[i : i + 1], gap[i : i + 1], first + reached, column
        )
    first += len(gauge)
    points, marks, differences = problem.control_rows, problem.control_rows_of_marks, problem.difference_rows
    at, on, names = points.point_indices, marks.point_indices, problem.marks.mark_names
    by_name: tuple[tuple[ReferenceKind, ControlRows, list[str], Sequence[str], Floats], ...] = (
        ("point", points, [recording.targets[t] for t in at], (), state.target_points[at]),
        ("point", marks, [names[s] for s in on], recording.stations, state.station_positions[on]),
        (
            "difference",
            differences,
            [*differences.names],
            (),
            differences.predict(state.target_points, state.station_positions),
        ),
    )
    for kind, controls, called, under, here in by_name:
        for i, place in enumerate(controls.point_indices.tolist()):
            axes = controls.is_declared_coordinate[i]
            root = controls.whitening_matrices[i][np.ix_(axes, axes)]
            sigma = np.linalg.norm(np.linalg.inv(root), axis=1)
            given_axes = "".join(axis for axis, is_axis in zip("xyz", axes, strict=True) if is_axis)
            rows = first + np.arange(len(root))
            gap, over = (controls.declared_points[i] - here[i])[axes], under[place] if under else ""
            yield ReferenceValueRows(kind, called[i], given_axes, sigma, gap, rows, root, occupied_by=over)
            first += len(root)
    tilts = -problem.level_rows.axis_tilts(state.station_rotations)
    for i, station in enumerate(problem.level_rows.station_indices.tolist()):
        sigma, rows = (
            np.full(2, problem.level_rows.tilt_sigmas[i]),
            problem.level_row_slice.start + 2 * i + np.arange(2),
        )
        yield ReferenceValueRows("level", recording.stations[station], "", sigma, tilts[i], rows, np.diag(1.0 / sigma))
    gap, first = problem.yaw_rows.yaw_residuals(state.station_rotations), problem.level_row_slice.stop
    for i, station in enumerate(problem.yaw_rows.station_indices.tolist()):
        sigma = problem.yaw_rows.yaw_sigmas[i : i + 1]
        rows = np.array([first + i])
        yield ReferenceValueRows(
            "yaw", recording.stations[station], "", sigma, gap[i : i + 1], rows, 1.0 / sigma[:, None]
        )
    yield from _centring_declarations(problem, state)


def common_scale_reference(problem: NetworkProblem, state: NetworkState) -> Iterator[ReferenceValueRows]:
    """Common scale of all reference lengths as a reference value; empty for fewer than two lengths.

    A wrong temperature or calibration of the lengths changes all of them in proportion.
    """
    gauge, felt = problem.gauge_rows, np.isfinite(problem.gauge_rows.total_sigmas)
    if felt.sum() > 1:
        shown = gauge.decorrelate(np.where(felt, gauge.lengths, 0.0)[:, None])
        weight, gap = float(np.sum(shown**2)), gauge.decorrelate(np.where(felt, problem.length_residuals(state), 0.0))
        rows, sigma = int(problem.is_used_reading.sum()) + np.arange(len(gauge)), np.array([weight**-0.5])
        expansion = common_expansion_per_k(problem.model.recording.gauge)
        misclosure = gap @ shown / weight
        yield ReferenceValueRows(
            "scale", "all known lengths", "", sigma, misclosure, rows, shown, expansion_per_k=expansion
        )


def _centring_declarations(problem: NetworkProblem, state: NetworkState) -> Iterator[ReferenceValueRows]:
    """Declarations that a set-up is exactly over its mark, as reference values.

    They can be tested only if the mark is measured as a target or lies under another set-up.
    """
    marks, recording = problem.marks, problem.model.recording
    shared = (marks.target_indices >= 0) | (
        np.bincount(marks.first_setup_on_mark, minlength=len(marks.first_setup_on_mark))[marks.first_setup_on_mark] > 1
    )
    if not shared.any():
        return
    number = np.cumsum(problem.is_used_reading).reshape(problem.is_used_reading.shape) - 1
    by_place = problem.model.linearise(state).pose_derivatives[:, :, :3] / problem.reading_sigmas[:, :, None]
    for s in np.flatnonzero(shared).tolist():
        readings = problem.is_used_reading & (recording.station == s)[:, None]
        if readings.any():
            name = recording.stations[s]
            yield ReferenceValueRows(
                "mark", name, "xyz", np.zeros(3), np.zeros(3), number[readings], -by_place[readings]
            )


def drop_reference(recording: Recording, reference_value: ReferenceValue) -> Recording:
    """Recording from whose `setup.toml` the reference value `reference_value` is removed."""
    setup, name = recording.setup, reference_value.name
    if reference_value.kind in ("length", "scale"):
        lengths = tuple(d for d in recording.gauge.distance if f"{d.from_}-{d.to}" != name)
        cleared: dict[str, object] = (
            {"sigma_scale_ppm": MIN_UNKNOWN_SCALE_SIGMA_PPM}
            if reference_value.kind == "scale"
            else {"distance": lengths}
        )
        change: dict[str, object] = {"gauge": recording.gauge.model_copy(update=cleared)}
    elif reference_value.kind == "difference":
        change = {"differences": tuple(difference for difference in setup.differences if difference.label != name)}
    elif reference_value.kind in STATION_UPDATES_REMOVING_REFERENCE:
        cleared = STATION_UPDATES_REMOVING_REFERENCE[reference_value.kind]
        change = {"stations": setup.stations | {name: setup.stations[name].model_copy(update=cleared)}}
    else:
        cleared = {"known_mm": None, "approximate_mm": setup.targets[name].known_mm}
        change = {"targets": setup.targets | {name: setup.targets[name].model_copy(update=cleared)}}
    return recording.replace(setup=setup.model_copy(update=change))


REFERENCE_COORDINATE_KEYS = ("known_mm", "known_sigma_mm", "known_covariance_mm2", "known_axes")
"""Keys of a target's reference coordinates in `setup.toml`."""


def full_reference_coordinates(recording: Recording) -> dict[int, Floats]:
    """Reference coordinates (3,) [m] by target index, of the targets whose three coordinates are all declared."""
    setups = map(recording.target_setup, recording.targets)
    return {
        i: MILLIMETRE * np.array(target.known_mm, dtype=np.float64)
        for i, target in enumerate(setups)
        if target.known_mm is not None and target.known_axes == "xyz"
    }


def without_reference_coordinates(recording: Recording) -> Recording:
    """Recording whose `setup.toml` contains no known coordinates of targets."""
    targets = {name: target.model_copy(update={"known_mm": None}) for name, target in recording.setup.targets.items()}
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))


def exchange_coordinates(recording: Recording, first_name: str, second_name: str) -> Recording:
    """Recording with the reference coordinates of two targets exchanged, of which one may have no coordinates."""
    targets = dict(recording.setup.targets)
    for here, there in ((first_name, second_name), (second_name, first_name)):
        coordinates = {key: getattr(recording.target_setup(there), key) for key in REFERENCE_COORDINATE_KEYS}
        targets[here] = recording.target_setup(here).model_copy(update=coordinates)
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))


def with_nonzero_reference_sigmas(problem: NetworkProblem, state: NetworkState) -> NetworkProblem:
    """Problem in which exact reference values get a small standard deviation, because a test requires one."""
    if not problem.is_used_reading.any():
        return problem
    range_ = problem.model.sightings_without_covariates(state).range_
    sigma_lengths = problem.reading_sigmas * np.stack([np.ones_like(range_), range_, range_], axis=1)
    floor = MIN_REFERENCE_TO_READING_SIGMA_RATIO * float(np.median(sigma_lengths[problem.is_used_reading]))
    if not floor > 0.0:  # angles alone, to a target at the position of the station
        return problem
    turn = floor / max(float(np.median(range_[problem.is_used_reading.any(axis=1)])), floor)
    floors = {
        "control_rows": floor,
        "control_rows_of_marks": floor,
        "difference_rows": floor,
        "level_rows": turn,
        "yaw_rows": turn,
    }
    tested = {name: getattr(problem, name).with_min_sigma(least) for name, least in floors.items()}
    exact = any(tested[name] is not getattr(problem, name) for name in floors)
    return replace(problem, **tested) if exact else problem
