"""A number or an identity for each effect that no other file of this folder has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.core.errors import ModelError
from ltsim.core.units import SI_PER_UNIT
from ltsim.geometry.polar import swap_front_and_raw, to_polar, wrap_angle
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.physics.effects.azimuth_drift import AzimuthDrift
from ltsim.physics.effects.backlash import Backlash
from ltsim.physics.effects.dead_path import DeadPath
from ltsim.physics.effects.encoder_interpolation import EncoderInterpolation
from ltsim.physics.effects.face_confusion import FaceConfusion
from ltsim.physics.effects.gauge_scale import GaugeScale
from ltsim.physics.effects.gauge_shape import GaugeShape
from ltsim.physics.effects.index_drift import IndexDrift
from ltsim.physics.effects.mesh_expansion import MeshExpansion
from ltsim.physics.effects.nest_lift import NestLift
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.effects.outlier import Outlier
from ltsim.physics.effects.range_cyclic import MAX_CANDIDATE_WAVELENGTH, MIN_CANDIDATE_WAVELENGTH, RangeCyclic
from ltsim.physics.effects.range_drift import RangeDrift
from ltsim.physics.effects.range_offset import RangeOffset
from ltsim.physics.effects.range_scale import RangeScale
from ltsim.physics.effects.range_step import RangeStep
from ltsim.physics.effects.refractivity_drift import RefractivityDrift
from ltsim.physics.effects.smr_centring import SmrCentring
from ltsim.physics.effects.smr_dihedral import SmrDihedral
from ltsim.physics.effects.smr_offset import SmrOffset
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.effects.station_levelling import StationLevelling
from ltsim.physics.effects.station_noise import StationNoise
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.physics.effects.target_swap import TargetSwap
from ltsim.physics.effects.timing_lag import TimingLag
from ltsim.physics.effects.vertical_index import VerticalIndex
from ltsim.physics.effects.window import Window
from ltsim.physics.effects.wrong_unit import WrongUnit
from tests.physics.effects.scenes import chosen, corrections, lengths, network_basis, remaining_signature, scene

SCENE = scene()
HOUR = 3600.0


def test_interpolation_error_repeats_at_the_same_angle_of_its_circle() -> None:
    effect = EncoderInterpolation(circle="elevation", periods=3600)
    design = -effect.design(SCENE)
    x = SCENE.ideal_raw_readings[:, 2]
    np.testing.assert_allclose(design[:, 2], np.stack([np.cos(3600 * x), np.sin(3600 * x)], axis=1), atol=1e-9)
    assert effect.observables == ("elevation",)


def test_backlash_turns_with_the_order_of_the_work() -> None:
    """Half the width, against the last move; the reverse order turns it at all but the ends of a visit."""
    front = chosen(SCENE, SCENE.face == 1)
    forward = -Backlash().design(front)
    reverse = -Backlash().design(replace(front, time=-front.time))
    for column, slot in ((0, 1), (1, 2)):
        assert set(np.round(np.unique(np.abs(forward[:, slot, column])), 9)) <= {0.0, 0.5}
        went_on = forward[1:-1, slot, column] * forward[2:, slot, column] > 0
        went_on &= (
            np.abs(wrap_angle(np.diff(front.ideal_raw_readings[:, slot])))[1:] > 1e-3
        )  # an axis that stays keeps its last side
        both = (reverse[1:-1, slot, column] != 0) & (forward[1:-1, slot, column] != 0) & went_on
        assert both.sum() > 30
        np.testing.assert_allclose(reverse[1:-1, slot, column][both], -forward[1:-1, slot, column][both])


def test_range_step_starts_at_its_time_and_ends_with_the_visit() -> None:
    rows = np.flatnonzero(SCENE.station == 2)
    middle = 0.5 * (SCENE.time[rows[20]] + SCENE.time[rows[21]])
    change = RangeStep(("S3",), time=float(middle)).design(SCENE)[:, 0, 0]
    np.testing.assert_array_equal(np.flatnonzero(change), rows[21:])
    np.testing.assert_array_equal(change[rows[21:]], -1.0)


def test_station_weather_is_the_range_scale_of_a_station() -> None:
    here = SCENE.station == 3
    change = StationWeather(("S4",)).design(SCENE)
    np.testing.assert_allclose(change[here], RangeScale().design(SCENE)[here], atol=1e-12)


def test_dead_path_follows_the_thermometer_and_requires_it() -> None:
    kelvin = SCENE.covariates["air_temperature_c"] - 20.0
    np.testing.assert_allclose(DeadPath().design(SCENE)[:, 0, 0], -kelvin)
    assert DeadPath.candidates(replace(SCENE, covariates={})) == []
    steady = {"air_temperature_c": np.full(len(SCENE), 20.0)}
    assert DeadPath.candidates(replace(SCENE, covariates=steady)) == []
    assert len(DeadPath.candidates(SCENE)) == 1


def test_cyclic_error_has_the_unit_length() -> None:
    """One wavelength farther it is the same, half of one farther the opposite; 150 mm at 1 GHz."""
    effect = RangeCyclic(wavelength=0.15)
    phase = 2 * np.pi * SCENE.range_ / 0.15
    np.testing.assert_allclose(-effect.design(SCENE)[:, 0], np.stack([np.cos(phase), np.sin(phase)], axis=1))
    assert pytest.approx(0.15, abs=2e-4) == 299_792_458.0 / (2 * 1e9)


def test_search_for_a_wavelength_misses_little() -> None:
    """Of any wavelength the nearest that is tried explains at least four fifths."""
    tried = RangeCyclic.candidates(SCENE)
    waves = np.array([e.wavelength for e in tried])
    rng = np.random.default_rng(3)
    for wavelength in 1 / rng.uniform(1 / MAX_CANDIDATE_WAVELENGTH, 1 / MIN_CANDIDATE_WAVELENGTH, 60):
        wave = np.cos(2 * np.pi * SCENE.range_ / wavelength + rng.uniform(0, 6))
        near = np.argsort(np.abs(1 / waves - 1 / wavelength))[:2]
        shares = []
        for i in near:
            columns = tried[i].design(SCENE)[:, 0]
            fitted = columns @ np.linalg.lstsq(columns, wave, rcond=None)[0]
            shares.append(float(fitted @ fitted / (wave @ wave)))
        assert max(shares) > 0.8


def test_drifts_after_an_hour_are_the_offsets_they_drift_by() -> None:
    expected = 1 * SI_PER_UNIT["um/h"] * HOUR
    assert expected == pytest.approx(1e-6)
    since = (SCENE.time - SCENE.time.min())[:, None, None]
    for drift, offset in ((RangeDrift(), RangeOffset()), (IndexDrift(), VerticalIndex())):
        np.testing.assert_allclose(drift.design(SCENE), offset.design(SCENE) * since, atol=1e-9)
    scale = RangeScale().design(SCENE) * since
    np.testing.assert_allclose(RefractivityDrift().design(SCENE), scale, atol=1e-9)


def test_warm_up_dies_away_and_visits_start_anew() -> None:
    warm = -RangeDrift(law="exponential", time_constant=600.0).design(SCENE)[:, 0, 0]
    np.testing.assert_allclose(warm, np.exp(-SCENE.time / 600.0))
    visit = -IndexDrift(("S2",), law="visit").design(SCENE)[:, 2, 0]
    rows = np.flatnonzero(SCENE.station == 1)
    np.testing.assert_allclose(visit[rows], SCENE.time[rows] - SCENE.time[rows[0]], atol=1e-9)
    assert not visit[SCENE.station != 1].any()


def test_azimuth_drift_over_the_recording_and_in_every_visit_are_the_same_up_to_yaw() -> None:
    gap = AzimuthDrift(law="linear").design(SCENE) - AzimuthDrift(law="visit").design(SCENE)
    assert np.linalg.norm(remaining_signature(SCENE, gap[:, :, 0])) < 1e-9 * np.linalg.norm(
        lengths(SCENE, gap[:, :, 0])
    )


def test_expanding_mesh_is_a_drifting_scale_of_the_ranges() -> None:
    """1.000 where both wait while a station measures, 0.99 where they go on."""
    waiting = replace(SCENE, time=1000.0 * SCENE.station)
    for s, least in ((waiting, 1.0 - 1e-9), (SCENE, 0.99)):
        mesh = remaining_signature(s, MeshExpansion(mode="uniform").design(s)[:, :, 0], scale=True)
        scale = remaining_signature(s, -RefractivityDrift().design(s)[:, :, 0], scale=True)
        assert mesh @ scale > least * np.linalg.norm(mesh) * np.linalg.norm(scale)


def test_steel_expands_by_69_um_over_6_m_and_1_kelvin() -> None:
    rows = chosen(SCENE, np.argsort(SCENE.time)[-1:].tolist())
    hours = (SCENE.time.max() - SCENE.time.min()) / HOUR
    rate = np.array([11.5 * SI_PER_UNIT["ppm/h"] / hours])
    late = replace(rows, time=rows.time)
    both = chosen(SCENE, [int(np.argmin(SCENE.time)), int(np.argmax(SCENE.time))])
    moved = MeshExpansion(mode="uniform").reading_change(both, rate)[1]
    arm = SCENE.target_points[late.target[0]] - SCENE.target_points.mean(axis=0)
    expected = both.target_derivatives[1] @ (11.5e-6 * arm)
    np.testing.assert_allclose(moved, expected, rtol=1e-3, atol=1e-12)
    assert pytest.approx(69e-6) == 11.5e-6 * 6.0


def test_vertical_expansion_lifts_only() -> None:
    change = MeshExpansion(mode="vertical").design(SCENE)[:, :, 0]
    height = SCENE.target_points[SCENE.target, 2] - SCENE.target_points[:, 2].mean()
    lift = SCENE.target_derivatives[:, :, 2] * (height * (SCENE.time - SCENE.time.min()))[:, None]
    np.testing.assert_allclose(change, lift, atol=1e-9)


def test_gauge_scale_and_shape_change_the_declared_lengths_only() -> None:
    """A length stated too short by s L; a nest that moved by D changes L by D along it ."""
    first, second = np.array([24, 24, 25]), np.array([25, 26, 27])
    points = SCENE.target_points
    true = np.linalg.norm(points[first] - points[second], axis=1)
    changed_lengths = true + GaugeScale().gauge_design(first, second, points) @ [164e-6]
    np.testing.assert_allclose(true, changed_lengths * (1 + 164e-6), rtol=1e-7)
    motion = np.array([20e-6, -10e-6, 5e-6])
    moved = points.copy()
    moved[25] += motion
    effect = GaugeShape((), ("T26",), 25)
    change = true - np.linalg.norm(moved[first] - moved[second], axis=1)
    np.testing.assert_allclose(effect.gauge_design(first, second, points) @ motion, change, atol=5e-9)
    assert not GaugeShape((), ("T01",), 0).gauge_design(first, second, points).any()
    assert pytest.approx(58e-6, abs=1e-6) == 164e-6 * 0.3576


def test_fixed_vertex_offset_is_a_displacement_and_is_absorbed() -> None:
    """The target sits elsewhere, exactly."""
    fixed = replace(SCENE, is_reaimed=np.zeros(28, dtype=bool), nest_normals=np.tile([0.0, 0.6, 0.8], (28, 1)))
    design = SmrCentring().design(fixed)
    basis = network_basis(fixed)
    for k in range(3):
        whole = lengths(fixed, design[:, :, k]).ravel()
        assert np.linalg.norm(whole - basis @ (basis.T @ whole)) < 1e-9 * np.linalg.norm(whole)
    np.testing.assert_allclose(design[:, :, 0], fixed.target_derivatives @ [0.0, 0.6, 0.8], atol=1e-12)


def test_axial_vertex_offset_of_a_reaimed_reflector_is_a_range_offset() -> None:
    """Delta_d = +e_a at alpha = 0, and the rest is lateral and the same on both faces."""
    turned = replace(SCENE, is_reaimed=np.ones(28, dtype=bool))
    design = SmrCentring().design(turned)
    np.testing.assert_allclose(design[:, :, 0], RangeOffset().design(turned)[:, :, 0], atol=1e-12)
    np.testing.assert_allclose(design[:, 0, 1:], 0.0, atol=1e-12)


def test_fixed_vertex_offset_shows_in_the_range_by_the_incidence() -> None:
    """Delta_d = e_a cos(alpha) + e_t sin(alpha) cos(chi - chi_0); 26 um at 30 deg is 13 um."""
    fixed = replace(SCENE, is_reaimed=np.zeros(28, dtype=bool))
    is_finite = np.isfinite(fixed.incidence_angle)
    offsets = -SmrCentring().design(fixed)[is_finite, 0]
    alpha, chi = fixed.incidence_angle[is_finite], fixed.incidence_direction[is_finite]
    expected = np.stack([np.cos(alpha), np.sin(alpha) * np.cos(chi), np.sin(alpha) * np.sin(chi)], axis=1)
    np.testing.assert_allclose(offsets, expected, atol=1e-9)
    assert 26.0 * np.sin(np.radians(30.0)) == pytest.approx(13.0)


def test_split_spot_is_a_constant_angle_of_its_reflector() -> None:
    changes = corrections(SmrDihedral((), ("T07",)), SCENE)[SCENE.target == 6]
    here = chosen(SCENE, SCENE.target == 6)
    np.testing.assert_allclose(changes[:, 1, 0] * np.cos(here.elevation), 1.0)
    np.testing.assert_allclose(changes[:, 2, 1], 1.0)
    assert not changes[:, 0].any()


@pytest.mark.parametrize(("degrees", "along", "across"), [(0.0, 1.500, 0.0), (30.0, 1.645, 0.58)])
def test_window_of_three_millimetres(degrees: float, along: float, across: float) -> None:
    """3 mm of glass: 1.500 mm at normal incidence, 1.645 mm at 30 deg, 0.58 mm across."""
    window = chosen(SCENE, [10])
    beam, lateral, _ = (v[0] for v in window.beam_vectors)
    angle = np.radians(degrees)
    normal = tuple(float(x) for x in np.cos(angle) * beam + np.sin(angle) * lateral)
    change = Window(pane_normal=normal).design(window)[:, :, 0] * 3e-3  # type: ignore[arg-type]
    length_change = lengths(window, change)[0]
    assert 1e3 * length_change[0] == pytest.approx(along, abs=5e-4)
    assert 1e3 * abs(length_change[1]) == pytest.approx(across, abs=5e-3)
    assert length_change[1] <= 1e-15  # away from the normal, which leans to the left
    assert length_change[2] == pytest.approx(0.0, abs=1e-12)


def test_other_ball_lifts_every_target_of_the_station_along_its_normal() -> None:
    """12.7 mm for 1.5 in taken for 0.5 in."""
    assert pytest.approx(12.7) == 25.4 / 2 * (1.5 - 0.5)
    change = SmrOffset(("S2",)).reading_change(SCENE, np.array([12.7e-3]))
    lifted = SCENE.target_points + 12.7e-3 * np.nan_to_num(SCENE.nest_normals)
    other = replace(SCENE, target_points=lifted)
    here = SCENE.station == 1
    gap = other.ideal_raw_readings - SCENE.ideal_raw_readings
    gap[:, 1] = wrap_angle(gap[:, 1])
    np.testing.assert_allclose(change[here], gap[here], atol=1e-13)


def test_nest_lift_is_along_the_normal_and_free_is_anywhere() -> None:
    along = NestLift(("S1",), ("T03",), "normal").design(SCENE)[:, :, 0]
    free = NestLift(("S1",), ("T03",), "free").design(SCENE)
    np.testing.assert_allclose(along, free @ SCENE.nest_normals[2], atol=1e-12)
    assert np.count_nonzero(np.abs(along).sum(axis=1)) == 2


def test_moved_target_is_displaced_equally_for_all_later_stations() -> None:
    rows = np.flatnonzero(SCENE.target == 4)
    step = float(SCENE.time[rows[4]])
    moved = SCENE.target_points.copy()
    motion = np.array([40e-6, 30e-6, -20e-6])
    moved[4] += motion
    change = TargetMoved((), ("T05",), step).reading_change(SCENE, motion)
    gap = replace(SCENE, target_points=moved).ideal_raw_readings - SCENE.ideal_raw_readings
    np.testing.assert_array_equal(np.flatnonzero(change.any(axis=1)), rows[4:])
    np.testing.assert_allclose(change[rows[4:]], gap[rows[4:]], atol=1e-14)
    creep = TargetMoved((), ("T05",), kind="creep").design(SCENE)
    step_design = TargetMoved((), ("T05",), kind="step").design(SCENE)
    np.testing.assert_allclose(creep, step_design * SCENE.time[:, None, None], atol=1e-9)


def test_steps_of_a_target_lie_between_its_visits() -> None:
    times = [e.time for e in TargetMoved.candidates(SCENE) if e.targets == ("T05",) and e.kind == "step"]
    rows = SCENE.target == 4
    assert len(times) == 4
    for time in times:
        before = set(SCENE.station[rows & (SCENE.time < time)].tolist())
        after = set(SCENE.station[rows & (SCENE.time >= time)].tolist())
        assert before
        assert after
        assert not before & after


def test_settling_station_ends_where_its_parameters_say() -> None:
    """63 % of the motion after one time constant; readings of a moved station, not corrections."""
    values = np.array([10e-6, -5e-6, 30e-6])
    effect = StationSettling(("S1",), time_constant=300.0)
    change = effect.reading_change(SCENE, values)
    row = int(np.argmin(np.abs(SCENE.time_since_station_start - 300.0) + 1e9 * (SCENE.station != 0)))
    share = 1 - np.exp(-SCENE.time_since_station_start[row] / 300.0)
    assert share == pytest.approx(0.632, abs=0.02)
    turned = matrix_from_rotation_vector(share * np.array([10e-6, -5e-6, 0.0])) @ SCENE.station_rotations[0]
    arm = SCENE.target_points[SCENE.target[row]] - SCENE.station_positions[0] - [0.0, 0.0, share * 30e-6]
    readings_after = swap_front_and_raw(to_polar((arm @ turned)[None]), SCENE.face[[row]])[0]
    np.testing.assert_allclose(change[row], readings_after - SCENE.ideal_raw_readings[row], atol=1e-13)


def test_bump_at_the_start_is_only_another_pose() -> None:
    early = StationBump(("S2",), time=0.0).design(SCENE)
    for k in range(6):
        whole = lengths(SCENE, early[:, :, k])
        assert np.linalg.norm(remaining_signature(SCENE, early[:, :, k])) < 1e-9 * np.linalg.norm(whole)
    for effect in StationBump.candidates(SCENE):
        here = SCENE.station == SCENE.station_names.index(effect.stations[0])
        assert min((SCENE.time[here] < effect.time).sum(), (SCENE.time[here] >= effect.time).sum()) >= 3


def test_levelling_error_is_only_another_pose_where_poses_are_free() -> None:
    for effect in (StationLevelling(), StationLevelling(("S4",))):
        design = effect.design(SCENE)
        for k in range(2):
            whole = lengths(SCENE, design[:, :, k])
            assert np.linalg.norm(remaining_signature(SCENE, design[:, :, k])) < 1e-9 * np.linalg.norm(whole)


def test_levelling_bias_turns_about_the_axes_of_the_instrument() -> None:
    """An instrument that leans about its x axis by b sees everything turned by -b about it."""
    change = StationLevelling().reading_change(SCENE, np.array([20e-6, 0.0]))
    turned = SCENE.local_points @ matrix_from_rotation_vector(np.array([20e-6, 0.0, 0.0]))
    gap = swap_front_and_raw(to_polar(turned), SCENE.face) - SCENE.ideal_raw_readings
    gap[:, 1] = wrap_angle(gap[:, 1])
    np.testing.assert_allclose(change, gap, atol=1e-13)


def test_lag_is_the_rate_of_the_approach() -> None:
    """Delta = rate times lag: 1 ms at 0.1 m/s is 100 um."""
    design = TimingLag().design(SCENE)
    here = np.flatnonzero(SCENE.station == 0)
    rate = (SCENE.ideal_raw_readings[here[1:], 0] - SCENE.ideal_raw_readings[here[:-1], 0]) / 15.0
    np.testing.assert_allclose(-design[here[1:], 0, 0], rate, atol=1e-12)
    assert not design[here[0]].any()
    assert pytest.approx(100e-6) == 0.1 * 1e-3


def test_swapped_targets_read_each_other() -> None:
    change = TargetSwap(("S3",), ("T02", "T09")).reading_change(SCENE, np.ones(1))
    swapped = SCENE.target.copy()
    swapped[SCENE.target == 1], swapped[SCENE.target == 8] = 8, 1
    gap = replace(SCENE, target=swapped).ideal_raw_readings - SCENE.ideal_raw_readings
    gap[:, 1] = wrap_angle(gap[:, 1])
    gap[SCENE.station != 2] = 0.0
    np.testing.assert_allclose(change, gap, atol=1e-12)
    assert len(TargetSwap.possible_blunders(SCENE)) == 5 * 28 * 27 // 2


def test_confused_faces_twice_are_right_again() -> None:
    confused = FaceConfusion(("S1",), face=2)
    once = SCENE.ideal_raw_readings + confused.reading_change(SCENE, np.ones(1))
    here = (SCENE.station == 0) & (SCENE.face == 2)
    front = SCENE.ideal_front_face_readings[here]
    np.testing.assert_allclose(wrap_angle(once[here, 1:] - front[:, 1:]), 0.0, atol=1e-12)
    np.testing.assert_array_equal(once[~here], SCENE.ideal_raw_readings[~here])
    back = FaceConfusion(("S1",), face=1).reading_change(replace(SCENE, face=np.where(here, 1, SCENE.face)), np.ones(1))
    np.testing.assert_allclose(
        wrap_angle((once + back)[here, 1:] - SCENE.ideal_raw_readings[here, 1:]), 0.0, atol=1e-12
    )


def test_wrong_units_have_the_ratios_of_their_units() -> None:
    """25.4, 1000, 10/9, and a zenith angle for an elevation."""
    factors = {"inch": (0, 1 / 25.4), "metre": (0, 1e-3), "gon": (1, 10 / 9)}
    here = SCENE.station == 1
    for mistake, (column, factor) in factors.items():
        effect = WrongUnit(("S2",), mistake=mistake)  # type: ignore[arg-type]
        read = SCENE.ideal_raw_readings + effect.reading_change(SCENE, np.ones(1))
        np.testing.assert_allclose(read[here, column], factor * SCENE.ideal_raw_readings[here, column])
    zenith = SCENE.ideal_raw_readings + WrongUnit(("S2",), mistake="zenith").reading_change(SCENE, np.ones(1))
    np.testing.assert_allclose(zenith[here, 2], np.pi / 2 - SCENE.ideal_raw_readings[here, 2])
    of_face = WrongUnit(("S2",), mistake="gon", face=2).reading_change(SCENE, np.ones(1))
    whole = WrongUnit(("S2",), mistake="gon").reading_change(SCENE, np.ones(1))
    np.testing.assert_array_equal(of_face, np.where((SCENE.face == 2)[:, None], whole, 0.0))
    with pytest.raises(ModelError, match="face = 3"):
        WrongUnit(("S2",), face=3)


def test_outlier_is_a_single_reading() -> None:
    change = Outlier((), (), 12, "azimuth").design(SCENE)
    assert np.argwhere(change).tolist() == [[12, 1, 0]]
    assert change[12, 1, 0] == -1.0
    effect = Outlier.candidates(SCENE)[12]
    assert (effect.row, effect.observable) == (12, "distance")
    assert effect.stations == (SCENE.station_names[SCENE.station[12]],)
    assert effect.targets == (SCENE.target_names[SCENE.target[12]],)


def test_noise_scales_the_variance_of_its_readings() -> None:
    sigma = np.full((len(SCENE), 3), 2.0)
    twice = NoiseLevel().variance(SCENE, sigma, np.array([3.0, 0.0, 0.0]))
    np.testing.assert_allclose(twice, [[16.0, 4.0, 4.0]] * len(SCENE))
    factor = StationNoise(("S5",)).variance(SCENE, sigma, np.array([0.0, 3.0, 3.0]))
    np.testing.assert_allclose(factor[SCENE.station == 4], [[4.0, 16.0, 16.0]] * 56)
    np.testing.assert_allclose(factor[SCENE.station != 4], 4.0)
