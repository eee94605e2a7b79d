"""Networks of every kind: what may be missing, what may be known beforehand, and start values from nothing."""

import dataclasses

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.fitting import multilaterate
from ltsim.adjustment.start import initial_network
from ltsim.core.errors import NetworkError
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import to_polar
from ltsim.geometry.rigid import align_rigidly, matrix_from_rotation_vector, rotation_about_z
from ltsim.physics.model.construction import ideal_construction, misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel
from ltsim.recordings.recording import DISTANCE_KIND_COLUMN, HEIGHT_COLUMNS, Recording
from ltsim.recordings.setup import Instrument, LengthGauge, Noise, Setup, Station, Target
from tests.families import family
from tests.networks import drawn, network

EXACT = 2e-8


def with_setup(recording: Recording, **changes) -> Recording:
    return recording.replace(setup=recording.setup.model_copy(update=changes))


def levelled(recording: Recording) -> Recording:
    return with_setup(recording, stations={name: Station(levelled=True) for name in recording.stations})


def with_reference_points(recording: Recording, points: np.ndarray, which, **changes) -> Recording:
    targets = dict(recording.setup.targets)
    for i in which:
        name = recording.targets[i]
        place = tuple(1e3 * points[i])
        targets[name] = targets.get(name, Target()).model_copy(
            update={"known_mm": place, "known_sigma_mm": 0.001, **changes}
        )
    return with_setup(recording, targets=targets)


def blanked(recording: Recording, rows: np.ndarray, columns) -> Recording:
    readings = recording.readings.copy()
    readings[np.ix_(np.flatnonzero(rows), columns)] = np.nan
    return recording.with_readings(readings)


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def assert_same_shape(adjustment, points: np.ndarray, atol: float = EXACT) -> None:
    assert adjustment.solution.has_converged, adjustment.solution.status
    np.testing.assert_allclose(distances(adjustment.state.target_points), distances(points), atol=atol)


# --- readings that are missing ------------------------------------------------------------------------------------


def test_targets_without_any_range_are_intersected():
    recording, truth = network(faces=2)
    adjustment = adjust(blanked(recording, np.isin(recording.target, [3, 17, 20]), [0]))
    assert not adjustment.is_gross_pointing.any()
    assert_same_shape(adjustment, truth.state.target_points)


def test_stations_without_ranges_or_without_angles_are_resected():
    recording, truth = network()
    recording = blanked(recording, recording.station == 1, [0])
    recording = blanked(recording, recording.station == 3, [1, 2])
    adjustment = adjust(recording)
    assert_same_shape(adjustment, truth.state.target_points)
    # Three turns of the station that reads ranges alone are no unknowns.
    assert adjustment.dof == adjustment.problem.is_used_reading.sum() + 6 - (6 * 5 + 3 * 28 - 6 - 3)
    there = np.linalg.norm(adjustment.state.station_positions[3] - adjustment.state.station_positions[0])
    assert there == pytest.approx(
        np.linalg.norm(truth.state.station_positions[3] - truth.state.station_positions[0]), abs=EXACT
    )


def test_azimuths_alone_and_elevations_alone_add_to_the_others():
    recording, truth = network()
    recording = blanked(levelled(recording), recording.station == 2, [0, 2])
    recording = blanked(recording, recording.station == 4, [1])
    adjustment = adjust(recording)
    assert_same_shape(adjustment, truth.state.target_points)
    # The height of the one and the yaw of the other are no unknowns.
    assert adjustment.dof == adjustment.problem.is_used_reading.sum() + 6 + 10 - (6 * 5 + 3 * 28 - 4 - 2)


def test_beams_alone_take_scale_and_frame_from_reference_points():
    recording, truth = network()
    recording = with_setup(blanked(recording, np.full(len(recording), True), [0]), gauge=None)
    adjustment = adjust(with_reference_points(recording, truth.state.target_points, [0, 9, 14, 22]))
    assert adjustment.problem.free_motions.shape[1] == 0
    np.testing.assert_allclose(adjustment.state.target_points, truth.state.target_points, atol=1e-7)
    with pytest.raises(NetworkError, match="if ranges or angles are missing"):
        adjust(recording)


def test_ranges_alone_are_multilaterated():
    recording, truth = network()
    adjustment = adjust(blanked(recording, np.full(len(recording), True), [1, 2]))
    assert_same_shape(adjustment, truth.state.target_points, atol=1e-6)
    assert adjustment.dof == 140 + 6 - (3 * 5 + 3 * 28 - 6)


def test_the_algebraic_beginning_is_exact():
    rng = random_stream(4, "points")
    points, stations = rng.uniform(-3, 3, (12, 3)), rng.uniform(-3, 3, (5, 3))
    multilateration = multilaterate(np.linalg.norm(stations[:, None] - points[None], axis=2))
    assert multilateration is not None
    np.testing.assert_allclose(
        distances(np.vstack(multilateration)), distances(np.vstack([stations, points])), atol=1e-8
    )


def test_what_no_reading_ties_is_named():
    recording, _ = network()
    lonely = blanked(recording, (recording.target == 5) & (recording.station != 2), [0, 1, 2])
    lonely = blanked(lonely, (recording.target == 5) & (recording.station == 2), [0])
    lonely = lonely.select(lonely.is_measured.any(axis=1))
    assert [lonely.targets[t] for t in np.flatnonzero(initial_network(lonely)[1])] == ["T06"]
    nothing = blanked(recording, np.full(len(recording), True), [0, 2])
    with pytest.raises(NetworkError, match="no station can be located"):
        initial_network(nothing)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("target", [5, 25])
def test_a_target_that_loses_its_azimuths_is_excluded_and_the_rest_adjusted(robust, target):
    recording, _ = network(seed=3, stations=3)
    here = recording.target == target
    lonely = blanked(recording, here & (recording.station == 2), [0, 1, 2])
    lonely = blanked(lonely, here & (recording.station < 2), [1, 2] if robust else [1])
    lonely = blanked(lonely, here & (recording.station == 1), [0])
    lonely = lonely.select(lonely.is_measured.any(axis=1))
    adjustment = adjust(lonely, misalignment_construction(), robust=robust)
    name = f"T{target + 1:02d}"
    assert adjustment.undetermined_targets == (name,)
    adjustment.solution.require_success()
    without = with_setup(recording.select(~here), gauge=gauge_without(recording, name))
    rest = adjust(without, misalignment_construction(), robust=robust)
    assert adjustment.dof == rest.dof
    assert adjustment.chi2 == pytest.approx(rest.chi2, rel=1e-9)
    others = [i for i, n in enumerate(adjustment.recording.targets) if n != name]
    np.testing.assert_allclose(adjustment.state.target_points[others], rest.state.target_points, atol=1e-10)
    np.testing.assert_allclose(adjustment.target_covariances[others], rest.target_covariances, rtol=1e-5, atol=1e-16)
    assert np.isnan(adjustment.target_covariances[adjustment.recording.targets.index(name)]).all()


def test_a_target_undetermined_without_rejected_readings_is_excluded():
    """Two stations see T06; one reading of each is not used: a range and an elevation leave a circle."""
    recording, _ = network(seed=3)
    recording = recording.select((recording.target != 5) | (recording.station < 2))
    use = np.ones(recording.readings.shape, dtype=bool)
    rows = np.flatnonzero(recording.target == 5)
    use[rows] = [[True, False, True], [False, False, False]]
    adjustment = adjust(recording, misalignment_construction(), reading_mask=use)
    assert adjustment.undetermined_targets == ("T06",)
    assert adjustment.is_rejected_reading[rows].all()
    rest = adjust(recording.select(recording.target != 5), misalignment_construction())
    assert adjustment.chi2 == pytest.approx(rest.chi2, rel=1e-9)
    use[rows[1], 1] = True
    assert adjust(recording, misalignment_construction(), reading_mask=use).undetermined_targets == ()


def test_a_target_whose_readings_contradict_each_other_leaves_a_robust_adjustment():
    """Azimuths of both of its stations apart by 700 urad: which is right nobody can say, what is left does not do."""
    recording, _ = network(seed=5)
    recording = recording.select((recording.target != 5) | (recording.station < 2))
    rows = np.flatnonzero(recording.target == 5)
    readings = recording.readings.copy()
    readings[rows, 1] += [4e-4, -3e-4]
    readings[rows[1], [0, 2]] = np.nan
    adjustment = adjust(recording.with_readings(readings), misalignment_construction(), robust=True)
    adjustment.solution.require_success()
    assert adjustment.undetermined_targets == ("T06",)
    assert adjustment.is_rejected_reading.sum() == 4
    rest = adjust(recording.select(recording.target != 5), misalignment_construction())
    assert adjustment.chi2 == pytest.approx(rest.chi2, rel=1e-9)


def test_a_target_that_two_ranges_place_leaves_a_robust_adjustment_where_they_contradict_each_other():
    """Two set-ups side by side, ranges 0.1 mm apart: which is right nobody can say, angles alone miss by metres."""
    recording, truth = network()
    places = truth.state.station_positions.copy()
    places[1] = places[0] + [2e-4, 0.0, 0.0]
    readings = MeasurementModel(recording, ideal_construction()).predict(
        dataclasses.replace(truth.state, station_positions=places)
    )
    readings += recording.reading_sigmas() * random_stream(5, "noise").standard_normal(readings.shape)
    selection = (recording.target != 5) | (recording.station < 2)
    recording = recording.with_readings(readings).select(selection)
    rows = np.flatnonzero(recording.target == 5)
    readings = recording.readings.copy()
    readings[rows, 0] += [5e-5, -5e-5]
    adjustment = adjust(recording.with_readings(readings), robust=True)
    assert adjustment.undetermined_targets == ("T06",)
    assert set(np.argwhere(adjustment.is_rejected_reading)[:, 0]) == set(rows)
    assert np.abs(adjustment.residuals[rows, 0]).max() < 2e-4
    assert not adjust(recording, robust=True).is_rejected_reading.any()


def gauge_without(recording, name):
    gauge = recording.gauge
    distances = tuple(d for d in gauge.distance if name not in (d.from_, d.to))
    return gauge.model_copy(update={"distance": distances})


# --- what is known beforehand -------------------------------------------------------------------------------------


def test_levelled_stations_need_two_common_targets():
    recording, truth = network()
    keep = (recording.station != 4) | np.isin(recording.target, [0, 13])
    with pytest.raises(NetworkError, match="S5"):
        adjust(recording.select(keep))
    assert_same_shape(adjust(levelled(recording.select(keep))), truth.state.target_points)


def test_levels_that_follow_a_curved_surface():
    """Plumb lines that differ are what the axes follow: ignoring it shows in the levels and nowhere else."""
    recording, truth = network()
    lines = np.array([[1e-3, 0, 1], [0, 2e-3, 1], [-1e-3, 1e-3, 1], [0, 0, 1], [2e-3, 0, 1]])
    lines /= np.linalg.norm(lines, axis=1)[:, None]
    tilts = matrix_from_rotation_vector(np.cross([0.0, 0.0, 1.0], lines))
    state = dataclasses.replace(truth.state, station_rotations=tilts @ truth.state.station_rotations)
    recording = recording.with_readings(
        MeasurementModel(recording, ideal_construction()).predict(
            dataclasses.replace(state, instrument_parameters=np.zeros((1, 0)))
        )
    )
    stations = {n: Station(levelled=True, vertical=tuple(v)) for n, v in zip(recording.stations, lines, strict=True)}
    adjustment = adjust(with_setup(recording, stations=stations))
    assert adjustment.problem.free_motions.shape[1] == 4
    assert adjustment.chi2 < 1e-3
    assert adjust(levelled(recording)).chi2 > 1e4


def test_reference_points_define_the_frame_along_their_reference_axes():
    recording, truth = network(seed=8)
    made = with_reference_points(levelled(recording), truth.state.target_points, [0])
    made = with_reference_points(made, truth.state.target_points, [5], known_axes="y")
    made = with_reference_points(made, truth.state.target_points, [7, 12], known_axes="z")
    adjustment = adjust(made, misalignment_construction())
    assert adjustment.problem.control_rows.n_coordinates == 6
    assert adjustment.problem.free_motions.shape[1] == 0
    assert np.abs(adjustment.state.target_points - truth.state.target_points).max() < 3e-4
    np.testing.assert_allclose(
        adjustment.state.target_points[[7, 12], 2], truth.state.target_points[[7, 12], 2], atol=3e-5
    )


def test_a_single_reference_point_and_levels_leave_the_yaw_to_the_datum():
    recording, truth = network(seed=8)
    made = with_reference_points(levelled(recording), truth.state.target_points, [0])
    targets = dict(made.setup.targets)
    place = tuple(1e3 * truth.state.target_points[12])
    name = made.targets[12]
    targets[name] = targets[name].model_copy(update={"approximate_mm": place, "datum": True})
    adjustment = adjust(with_setup(made, targets=targets), misalignment_construction())
    assert adjustment.problem.free_motions.shape[1] == 1
    assert np.abs(adjustment.state.target_points - truth.state.target_points).max() < 1e-3
    arm, gap = (
        truth.state.target_points[12] - truth.state.target_points[0],
        adjustment.state.target_points[12] - truth.state.target_points[12],
    )
    assert abs(arm[0] * gap[1] - arm[1] * gap[0]) < 1e-9


# --- marks and heights --------------------------------------------------------------------------------------------


def total_stations(seed: int | None = None) -> tuple[Recording, np.ndarray]:
    """Six levelled instruments on marks that are each other's targets, heights over the marks, two sets at the first.

    Readings are computed here by hand, without the measurement model.
    """
    rng = random_stream(11, "marks")
    marks = np.column_stack([rng.uniform(0, 60, (9, 2)), rng.uniform(0, 5, 9)])
    names = [f"M{i}" for i in range(9)]
    over = [0, 1, 2, 3, 4, 5, 0]
    stations = ["M0", "M1", "M2", "M3", "M4", "M5", "M0#2"]
    instrument, target = rng.uniform(1.4, 1.8, 7), rng.uniform(0.1, 2.0, 9)
    yaw = rng.uniform(-3, 3, 7)
    rows, readings = [], []
    for s, mark in enumerate(over):
        for t in range(9):
            if t == mark:
                continue
            up = np.array([0.0, 0.0, 1.0])
            arm = marks[t] + target[t] * up - marks[mark] - instrument[s] * up
            readings.append(to_polar((rotation_about_z(yaw[s]).T @ arm)[None])[0])
            rows.append((s, t))
    station, indices = np.array(rows, dtype=np.int64).T
    setup = Setup(
        instrument=Instrument(noise=Noise(distance_mm=1.0, azimuth_arcsec=1.0, elevation_arcsec=1.0)),
        stations={
            n: Station(levelled=True, levelling_sigma_arcsec=1e-3, over=names[m], instrument_height_mm=1e3 * h)
            for n, m, h in zip(stations, over, instrument, strict=True)
        },
        targets={n: Target(height_mm=1e3 * h) for n, h in zip(names, target, strict=True)},
    )
    recording = Recording(
        setup,
        tuple(stations),
        tuple(names),
        station,
        indices,
        np.ones_like(station),
        np.ones_like(station),
        np.arange(len(station), dtype=np.float64),
        np.array(readings),
    )
    if seed is not None:
        noise = random_stream(seed, "noise").standard_normal(recording.readings.shape)
        recording = recording.with_readings(recording.readings + recording.reading_sigmas() * noise)
    return recording, marks


def test_instruments_on_marks_share_the_place_of_the_target():
    recording, marks = total_stations()
    adjustment = adjust(recording)
    assert_same_shape(adjustment, marks)
    assert adjustment.problem.unknowns.n_columns == 3 * 9 + 3 * 7
    assert adjustment.dof == 3 * len(recording) + 2 * 7 - 3 * 9 - 3 * 7 + 4
    height = 1e-3 * recording.station_setup("M0").instrument_height_mm
    np.testing.assert_allclose(
        adjustment.state.station_positions[0] - adjustment.state.target_points[0], [0, 0, height], atol=1e-12
    )
    np.testing.assert_array_equal(adjustment.state.station_positions[0][:2], adjustment.state.station_positions[6][:2])


def test_a_start_off_the_marks_is_put_onto_them():
    recording, _ = total_stations(3)
    adjustment = adjust(recording)
    off = dataclasses.replace(adjustment.state, station_positions=adjustment.state.station_positions + 0.3)
    again = adjust(recording, start_state=off)
    np.testing.assert_allclose(again.state.station_positions, adjustment.state.station_positions, atol=1e-9)
    assert again.chi2 == pytest.approx(adjustment.chi2, abs=1e-6)


def test_heights_of_single_pointings_and_horizontal_distances():
    recording, marks = total_stations()
    heights = recording.heights_above_marks()
    stations = {n: s.model_copy(update={"instrument_height_mm": 0.0}) for n, s in recording.setup.stations.items()}
    columns = dict(zip(HEIGHT_COLUMNS, (1e3 * heights[0], 1e3 * heights[1]), strict=True))
    moved = with_setup(recording, stations=stations, targets={}).replace(covariates=columns)
    assert_same_shape(adjust(moved), marks)
    flat = np.arange(len(recording)) % 2 == 0
    readings = recording.readings.copy()
    readings[flat, 0] *= np.cos(readings[flat, 2])
    labels = {DISTANCE_KIND_COLUMN: tuple("horizontal" if f else "" for f in flat)}
    assert_same_shape(adjust(recording.with_readings(readings).replace(labels=labels)), marks)


def test_marks_that_are_no_targets_are_shared_and_may_have_reference_values():
    recording, marks = total_stations()
    # The first mark is seen from nowhere; its two sets stand on a known place.
    keep = recording.select(~np.isin(recording.target, [0]))
    assert "M0" not in keep.targets
    place = Target(known_mm=tuple(1e3 * marks[0]), known_sigma_mm=0.01)
    adjustment = adjust(with_setup(keep, targets={**keep.setup.targets, "M0": place}))
    assert adjustment.problem.free_motions.shape[1] == 1
    assert adjustment.problem.unknowns.n_columns == 3 * 9 + 3 * 7
    height = 1e-3 * recording.station_setup("M0").instrument_height_mm
    np.testing.assert_allclose(adjustment.state.station_positions[0], marks[0] + [0, 0, height], atol=1e-8)
    assert_same_shape(adjustment, marks[1:])


def test_reference_points_may_have_a_full_covariance():
    """Turned with their covariances they give the same network turned; alike in all directions they are as before."""
    recording, truth = network(seed=3, stations=3)
    points, places = truth.state.target_points, [2, 9, 14, 21]
    shifted = points + 1e-3 * random_stream(3, "known").standard_normal(points.shape)
    roots = random_stream(3, "roots").uniform(0.3, 2.0, (len(points), 3, 3))
    results = []
    for turn in (np.eye(3), rotation_about_z(0.7)):
        targets = {}
        for i in places:
            matrix = turn @ (roots[i] @ roots[i].T) @ turn.T
            place = tuple(1e3 * turn @ shifted[i])
            entries = tuple(matrix[np.triu_indices(3)])
            targets[recording.targets[i]] = Target(known_mm=place, known_covariance_mm2=entries)
        results.append(adjust(with_setup(recording, targets=targets)))
        assert results[-1].solution.has_converged
    assert results[1].chi2 == pytest.approx(results[0].chi2, rel=1e-9)
    np.testing.assert_allclose(
        results[1].state.target_points, results[0].state.target_points @ rotation_about_z(0.7).T, atol=1e-9
    )
    gap = results[0].state.target_points[places[0]] - shifted[places[0]]
    assert np.linalg.norm(gap) > 1e-4
    by_sigma = adjust(with_reference_points(recording, shifted, places, known_sigma_mm=0.5))
    by_matrix = adjust(
        with_reference_points(recording, shifted, places, known_covariance_mm2=(0.25, 0, 0, 0.25, 0, 0.25))
    )
    assert by_matrix.chi2 == pytest.approx(by_sigma.chi2, rel=1e-12)


@pytest.mark.parametrize("entries", [(1, 2, 0, 1, 0, 1), (1, 0, 0, 1, 0, 0), (-1, 0, 0, 1, 0, 1)])
def test_a_covariance_is_positive_in_every_direction(entries):
    with pytest.raises(ValueError, match="positive definite covariance matrix"):
        Target(known_mm=(0, 0, 0), known_covariance_mm2=entries)


def test_the_start_is_good_enough_with_the_noise_of_total_stations():
    for seed in range(5):
        recording, marks = total_stations(seed)
        recording = blanked(recording, random_stream(seed, "rows").uniform(size=len(recording)) < 0.5, [0])
        adjustment = adjust(recording)
        assert adjustment.solution.has_converged
        assert adjustment.p_value > 1e-5
        assert not adjustment.is_gross_pointing.any()
        assert_same_shape(adjustment, marks, atol=0.01)


# --- several instruments, datum -----------------------------------------------------------------------------------


def test_each_instrument_has_separate_parameters():
    construction = misalignment_construction()
    values = np.stack([drawn(construction, 1), drawn(construction, 2)])
    recording, truth = network(faces=2)
    stations = {n: Station(instrument="AB"[i % 2]) for i, n in enumerate(recording.stations)}
    recording = with_setup(recording, stations=stations, instruments={"A": Instrument(), "B": Instrument()})
    state = dataclasses.replace(truth.state, instrument_parameters=values)
    recording = recording.with_readings(MeasurementModel(recording, construction).predict(state))
    noise = random_stream(3, "noise").standard_normal(recording.readings.shape)
    adjustment = adjust(recording.with_readings(recording.readings + recording.reading_sigmas() * noise), construction)
    for i in range(2):
        error = adjustment.state.instrument_parameters[i] - values[i]
        normalised = error @ np.linalg.solve(adjustment.instrument_covariance_of(i), error) / construction.n_parameters
        assert 0.3 < normalised < 2.2
    assert adjustment.p_value > 0.001


def test_the_datum_of_chosen_points_has_the_least_trace_and_keeps_their_mean():
    recording, _ = network(seed=4)
    recording = with_setup(recording, gauge=LengthGauge())
    chosen = [recording.targets[i] for i in (0, 7, 12, 20, 23)]
    at = [recording.targets.index(n) for n in chosen]
    plain, tied = (
        adjust(recording, misalignment_construction()),
        adjust(recording, misalignment_construction(), datum_names=chosen),
    )
    trace = [np.trace(a.target_covariances[at].sum(axis=0)) for a in (plain, tied)]
    assert trace[1] < 0.9 * trace[0]
    whole = adjust(recording, misalignment_construction(), datum_names=recording.targets)
    assert np.trace(whole.target_covariances.sum(axis=0)) < np.trace(tied.target_covariances.sum(axis=0))
    assert np.trace(whole.target_covariances[at].sum(axis=0)) > trace[1]
    np.testing.assert_allclose(tied.residuals, plain.residuals, atol=1e-12)
    np.testing.assert_allclose(
        tied.retained_covariance[np.ix_(*2 * [tied.problem.unknowns.pose_columns[2]])],
        tied.pose_covariance[2],
        rtol=1e-8,
    )


def test_a_declared_datum_moves_the_network_to_its_approximate_coordinates():
    recording, truth = network(seed=4)
    turn, shift = rotation_about_z(0.7), np.array([30.0, -10.0, 2.0])
    rough = truth.state.target_points @ turn.T + shift + 1e-3 * random_stream(1, "rough").standard_normal((28, 3))
    targets = {
        n: t.model_copy(update={"approximate_mm": tuple(1e3 * rough[i]), "datum": i % 2 == 0})
        for i, (n, t) in enumerate((n, recording.target_setup(n)) for n in recording.targets)
    }
    adjustment = adjust(with_setup(recording, targets=targets), misalignment_construction())
    gap = adjustment.state.target_points[::2] - rough[::2]
    arms = rough[::2] - rough[::2].mean(axis=0)
    np.testing.assert_allclose(gap.mean(axis=0), 0, atol=1e-10)
    np.testing.assert_allclose(np.cross(arms, gap).sum(axis=0), 0, atol=1e-6)
    assert adjustment.datum is not None


# --- anything missing anywhere ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", family(range(12), 3))
@pytest.mark.parametrize("kind", ["tracker", "levelled", "known", "marks"])
def test_any_readings_may_be_missing(kind, seed):
    """Sixty per cent of the ranges, a quarter of everything, or nine ranges of ten: it starts, converges and fits."""
    if kind == "marks":
        recording, points = total_stations(seed)
    else:
        recording, truth = network(seed=seed)
        points = truth.state.target_points
    if kind == "levelled":
        recording = levelled(recording)
    if kind == "known":  # In the coordinates of a country: 1e-10 m is all that is left of the digits.
        recording = with_reference_points(recording, points + 1e6, random_stream(seed, "known").permutation(28)[:4])
    lost = random_stream(seed, "lost").uniform(size=recording.readings.shape)
    share = [(0.6, 0, 0), (0.25, 0.25, 0.25), (0.9, 0, 0)][seed % 3]
    recording = recording.with_readings(np.where(lost < share, np.nan, recording.readings))
    recording = recording.select(recording.is_measured.any(axis=1))
    adjustment = adjust(recording)
    assert adjustment.p_value > 1e-5
    assert not adjustment.is_gross_pointing.any()
    rough = 0.02 if kind == "marks" else 1e-3
    assert_same_shape(adjustment, points, atol=rough)


def test_a_network_in_plan_needs_no_elevations() -> None:
    """Azimuths and horizontal distances between levelled set-ups, every height stated: solved as surveyors do in xy."""
    recording, truth = network(seed=3, stations=3)
    flat = recording.readings.copy()
    flat[:, 0] *= np.cos(flat[:, 2])
    flat[:, 2] = np.nan
    points = truth.state.target_points
    targets = {
        name: Target(known_mm=(0.0, 0.0, 1e3 * float(points[t, 2])), known_axes="z", known_sigma_mm=1e-3)
        for t, name in enumerate(recording.targets)
    }
    stations = {name: Station(levelled=True, over=f"M{name}") for name in recording.stations}
    for name, place in zip(recording.stations, truth.state.station_positions, strict=True):
        targets[f"M{name}"] = Target(known_mm=(0.0, 0.0, 1e3 * float(place[2])), known_axes="z", known_sigma_mm=1e-3)
    setup = recording.setup.model_copy(update={"targets": targets, "stations": stations, "gauge": None})
    kind = {DISTANCE_KIND_COLUMN: ("horizontal",) * len(recording)}
    adjustment = adjust(recording.replace(readings=flat, setup=setup, labels={**recording.labels, **kind}))
    assert adjustment.solution.has_converged
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.3)
    turn, shift = align_rigidly(adjustment.state.target_points, points)
    assert np.abs(adjustment.state.target_points @ turn.T + shift - points).max() < 1e-4
