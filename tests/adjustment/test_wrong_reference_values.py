"""Known values are observations: a wrong one is named and left out, not the readings that meet it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.axes import with_axes_from_points, with_control_points
from ltsim.adjustment.quality import adjustment_warnings
from ltsim.adjustment.reference_tests import ReferenceTest, length_sigma
from ltsim.calibration.network import calibrate_network
from ltsim.core.errors import RecordError
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import wrap_angle
from ltsim.geometry.rigid import align_rigidly
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Station, Target
from tests.families import family
from tests.networks import mesh, network

SIX = ("T01", "T06", "T12", "T16", "T20", "T25")
SIGMA = 0.01


def controlled(seed: int, off: dict[str, float] | None = None, *, stations: int = 5, faces: int = 1) -> Recording:
    """The workshop with six control points, some of them `off` by so many mm in a direction of their own."""
    recording, _ = network(seed=seed, stations=stations, faces=faces)
    rng, targets = random_stream(seed, "control"), dict(recording.setup.targets)
    for name in SIX:
        place = 1e3 * mesh()[recording.targets.index(name)] + SIGMA * rng.standard_normal(3)
        away = rng.standard_normal(3)
        place = place + (off or {}).get(name, 0.0) * away / np.linalg.norm(away)
        reference = {"known_mm": tuple(place.tolist()), "known_sigma_mm": SIGMA}
        targets[name] = targets[name].model_copy(update=reference)
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))


def without_point(recording: Recording, name: str) -> Recording:
    targets = dict(recording.setup.targets)
    targets[name] = targets[name].model_copy(update={"known_mm": None})
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))


def with_length(recording: Recording, number: int, more_mm: float) -> Recording:
    assert recording.setup.gauge is not None
    lengths = list(recording.setup.gauge.distance)
    lengths[number] = lengths[number].model_copy(update={"length_mm": lengths[number].length_mm + more_mm})
    gauge = recording.setup.gauge.model_copy(update={"distance": tuple(lengths)})
    return recording.replace(setup=recording.setup.model_copy(update={"gauge": gauge}))


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("size", family([0.3, 200.0, 1.0, 10.0], 2))
def test_a_wrong_control_point_is_named_and_the_readings_stay(size: float, robust: bool) -> None:
    for i, name in enumerate(SIX):
        recording = controlled(10 + i, {name: size}, stations=3)
        adjustment, sound = adjust(recording, robust=robust), adjust(without_point(recording, name), robust=robust)
        (wrong,) = adjustment.rejected_references
        assert (wrong.kind, wrong.name, wrong.is_excluded) == ("point", name, True)
        assert float(np.linalg.norm(wrong.error)) == pytest.approx(1e-3 * size, abs=0.1e-3)
        assert adjustment.is_rejected_reading.sum() == sound.is_rejected_reading.sum()
        miss, least = (np.sqrt(np.mean((x.state.target_points - mesh()) ** 2)) for x in (adjustment, sound))
        assert miss < 1.2 * least
        assert f"the known coordinates of {name} are off by" in adjustment_warnings(adjustment)[0]


def test_two_wrong_control_points_and_a_bad_reading() -> None:
    recording = controlled(3, {"T06": 4.0, "T20": 0.5})
    readings = recording.readings.copy()
    readings[17, 0] += 0.2e-3
    adjustment = adjust(recording.with_readings(readings), robust=True)
    assert sorted(test.name for test in adjustment.rejected_references) == ["T06", "T20"]
    assert np.argwhere(adjustment.is_rejected_reading).tolist() == [[17, 0]]


def without_lengths(recording: Recording) -> Recording:
    return recording.replace(setup=recording.setup.model_copy(update={"gauge": None}))


def test_consistent_networks_use_every_reference_value() -> None:
    """Tests in a network with lengths include the constants of the instrument, which are zero here."""
    for seed in range(12):
        recording = controlled(100 + seed, stations=3)
        assert adjust(recording).rejected_references == ()
        adjustment = adjust(without_lengths(recording))
        assert adjustment.rejected_references == ()
        normal = [test.chi2_drop for test in adjustment.reference_tests if test.kind == "point"]
        assert 1.0 < np.mean(normal) < 6.5  # chi-square with three degrees of freedom


@pytest.mark.long
def test_of_a_hundred_sound_networks_five_are_blamed_at_most() -> None:
    assert sum(bool(adjust(controlled(1000 + seed, stations=3)).rejected_references) for seed in range(100)) <= 5
    blamed = 0
    for seed in range(100):
        recording = network(seed=seed, stations=3)[0]
        noise = 2e-5 * random_stream(seed, "axes").standard_normal(mesh().shape)
        points = {name: (mesh() + noise)[recording.targets.index(name)] for name in SIX}
        blamed += any(
            test.is_excluded for test in adjust(with_axes_from_points(recording, points, "hall.csv")).axes_point_tests
        )
    assert blamed <= 5


@pytest.mark.parametrize("more", [0.1, 1.0])
def test_a_wrong_gauge_length_is_named_and_no_reading(more: float) -> None:
    recording = with_length(network(seed=2)[0], 2, more)
    adjustment = lt.adjust(recording)
    assert adjustment.outliers == ()
    assert next((k.kind, k.name, k.excluded) for k in adjustment.reference_values) == ("length", "T25-T28", True)
    assert adjustment.reference_values[0].error == pytest.approx(more, abs=0.01)
    assert adjustment.fit.sigma0 == pytest.approx(1.0, abs=0.1)
    assert adjustment.verdict is not None
    assert "The known length T25-T28 is off by" in adjustment.verdict.sentence


@pytest.mark.parametrize("degrees", family([-4.0, 7.0]))
def test_a_wrong_gauge_temperature_is_reported_for_all_its_lengths_and_for_no_reading(degrees: float) -> None:
    right = recording = network(seed=2, faces=2)[0]
    assert recording.setup.gauge is not None
    temperature = {"measured_at_c": 20.0 + degrees, "expansion_per_k": 23.2e-6}
    gauge = recording.setup.gauge.model_copy(update=temperature)
    recording = recording.replace(setup=recording.setup.model_copy(update={"gauge": gauge}))
    adjustment = lt.adjust(recording)
    assert (adjustment.reference_values[0].kind, adjustment.reference_values[0].excluded) == ("scale", True)
    assert adjustment.fit.sigma0 == pytest.approx(1.0, abs=0.1)  # the readings do not pay
    unscaled = right.replace(setup=right.setup.model_copy(update={"gauge": None}))
    np.testing.assert_allclose(adjustment.target_points, lt.adjust(unscaled).target_points, atol=5e-6)
    assert adjustment.reference_values[0].error == pytest.approx(23.2 * degrees, abs=15.0)
    assert adjustment.verdict is not None
    assert f"too {'long' if degrees > 0 else 'short'} (w = " in adjustment.verdict.sentence
    result = lt.check(recording)
    no_go = [item.sentence for item in result.items if item.kind == "reference" and not item.passed]
    assert len(no_go) == 1
    assert no_go[0].startswith("all known lengths are ")
    assert "a temperature of lengths with 23.2 ppm/K that is wrong by" in no_go[0]


def test_a_calibration_does_not_follow_lengths_so_far_off_that_no_scale_of_an_instrument_is() -> None:
    recording = network(seed=2, faces=2)[0]
    assert recording.setup.gauge is not None
    gauge = recording.setup.gauge.model_copy(update={"measured_at_c": 45.0, "expansion_per_k": 23.2e-6})
    calibration = lt.calibrate(recording.replace(setup=recording.setup.model_copy(update={"gauge": gauge})))
    assert (calibration.reference_values[0].kind, calibration.reference_values[0].excluded) == ("scale", True)
    assert calibration.fit.sigma0 == pytest.approx(1.0, abs=0.1)
    scale = calibration.parameters[calibration.instrument_parameter_names.index("range-scale")]
    assert abs(scale.value) < 3.0 * scale.prior_sigma
    assert not calibration.outliers


def test_a_wrong_level_and_a_wrong_height_are_named() -> None:
    recording, _ = network(seed=6, faces=2)
    stations = {name: Station(levelled=True, levelling_sigma_arcsec=1.0) for name in recording.stations}
    levelled = recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))
    assert adjust(levelled).rejected_references == ()
    tilted = {**stations, "S3": stations["S3"].model_copy(update={"vertical": (2e-4, 0.0, 1.0)})}
    adjustment = adjust(levelled.replace(setup=levelled.setup.model_copy(update={"stations": tilted})))
    assert [(test.kind, test.name) for test in adjustment.rejected_references] == [("level", "S3")]
    heights = dict(recording.setup.targets)
    for name in SIX:
        z = 1e3 * float(mesh()[recording.targets.index(name), 2]) + (1020.0 if name == "T16" else 0.0)
        heights[name] = Target(known_mm=(0.0, 0.0, z), known_axes="z", known_sigma_mm=0.05)
    adjustment = adjust(levelled.replace(setup=levelled.setup.model_copy(update={"targets": heights})))
    assert [(test.kind, test.name, test.declared_axes) for test in adjustment.rejected_references] == [
        ("point", "T16", "z")
    ]
    assert adjustment.rejected_references[0].error[0] == pytest.approx(1.02, abs=1e-3)


def test_reference_azimuth_zeros_orient_the_network_and_a_wrong_zero_is_reported() -> None:
    recording, _ = network(seed=6, faces=2)
    ahead = adjust(recording).state.station_rotations[:, :, 0]
    yaws = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0])) + 100.0

    def oriented(off_arcsec: float) -> Recording:
        stations = {
            name: Station(levelled=True, yaw_deg=yaw + (off_arcsec / 3600 if name == "S3" else 0), yaw_sigma_arcsec=2.0)
            for name, yaw in zip(recording.stations, yaws.tolist(), strict=True)
        }
        return recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))

    sound, wrong = adjust(oriented(0.0)), adjust(oriented(60.0))
    assert sound.rejected_references == ()
    assert sound.problem.free_motions.shape[1] == 3
    turned = sound.state.station_rotations[:, :, 0]
    assert np.abs(wrap_angle(np.arctan2(turned[:, 1], turned[:, 0]) - np.radians(yaws))).max() < 2e-5
    assert [(test.kind, test.name) for test in wrong.rejected_references] == [("yaw", "S3")]
    assert 3600 * np.degrees(wrong.rejected_references[0].error[0]) == pytest.approx(60.0, abs=6.0)
    assert "the azimuth zero of S3 is off by" in wrong.rejected_references[0].sentence


def test_of_two_points_that_contradict_each_other_nobody_can_tell_which() -> None:
    recording = controlled(4, {"T06": 3.0})
    for name in ("T12", "T16", "T20", "T25"):
        recording = without_point(recording, name)
    adjustment = adjust(recording)
    (test,) = adjustment.rejected_references
    assert {test.name, *test.indistinguishable_from} == {"T01", "T06"}
    assert not test.is_excluded
    assert "do not show which one is wrong" in adjustment_warnings(adjustment)[0]


def with_two_lengths(recording: Recording, first_mm: float, second_mm: float) -> Recording:
    """The network with two lengths that share no end, wrong by so much."""
    wrong = with_length(with_length(recording, 0, first_mm), 5, second_mm)
    assert wrong.setup.gauge is not None
    two = tuple(wrong.setup.gauge.distance[i] for i in (0, 5))
    assert len({end for line in two for end in (line.from_, line.to)}) == 4
    gauge = wrong.setup.gauge.model_copy(update={"distance": two})
    return wrong.replace(setup=wrong.setup.model_copy(update={"gauge": gauge}))


@pytest.mark.long
@pytest.mark.parametrize("wrong", [0.3, 0.03])
def test_of_two_lengths_that_are_exchanged_none_is_believed(wrong: float) -> None:
    """Each contradicts the ranges and the other one: both are reported, and no effect is made of them."""
    recording, truth = network(seed=2, faces=2)
    adjustment = adjust(with_two_lengths(recording, wrong, -wrong))
    (test,) = adjustment.rejected_references
    assert (test.kind, test.is_excluded, len(test.indistinguishable_from)) == ("length", False, 1)
    diagnosis = lt.diagnose(with_two_lengths(recording, wrong, -wrong), held_out=False)
    assert [finding.carrier for finding in diagnosis.findings] == ["reference length"] * 2
    rotation, shift = align_rigidly(diagnosis.targets.points, truth.state.target_points)
    off = diagnosis.targets.points @ rotation.T + shift - truth.state.target_points
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 20e-6


def test_two_lengths_that_are_right_contradict_nothing() -> None:
    assert all(
        adjust(with_two_lengths(network(seed=k, faces=2)[0], 0.0, 0.0)).rejected_references == () for k in range(5)
    )


def test_calibration_keeps_its_lengths_and_its_table_is_saved() -> None:
    calibration = calibrate_network(controlled(5, {"T12": 1.0}, faces=2), recommend_measurements=False)
    content = calibration.content()
    entries = [e for e in content["reference_values"] if e["name"] == "T12"]
    assert [e["component"] for e in entries] == ["x", "y", "z"]
    assert all(e["excluded"] and e["unit"] == "mm" for e in entries)
    assert len(content["reference_values"]) == 3 * len(SIX) + 6
    others = [e for e in content["reference_values"] if e["kind"] == "point" and not e["excluded"]]
    assert all(0.0 < e["redundancy"] < 1.0 and e["minimal_detectable_error"] > 0.0 for e in others)


@pytest.mark.parametrize("size", family([0.3, 200.0, 1.0, 10.0], 2))
def test_a_point_inconsistent_with_the_axes_of_the_others_is_excluded_from_the_datum(size: float) -> None:
    recording = network(seed=4, stations=3)[0]
    noise = 2e-5 * random_stream(4, "axes").standard_normal(mesh().shape)
    places = mesh() @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + [12.0, -4.0, 7.0]
    for name in SIX:
        points = {n: (places + noise)[recording.targets.index(n)] for n in SIX}
        points[name] = points[name] + 1e-3 * size * np.array([0.48, -0.6, 0.64])
        adjustment = adjust(with_axes_from_points(recording, points, "hall.csv"))
        assert [test.name for test in adjustment.axes_point_tests if test.is_excluded] == [name]
        rest = {n: place for n, place in points.items() if n != name}
        sound = adjust(with_axes_from_points(recording, rest, "hall.csv"))
        np.testing.assert_allclose(adjustment.state.target_points, sound.state.target_points, atol=1e-8)


def with_declared_noise(recording: Recording, factor: float) -> Recording:
    """The same readings, with the declared standard deviations of all of them multiplied by a factor."""
    noise = recording.setup.instrument.noise
    larger = {name: factor * getattr(noise, name) for name in type(noise).model_fields}
    instrument = recording.setup.instrument.model_copy(update={"noise": noise.model_copy(update=larger)})
    return recording.replace(setup=recording.setup.model_copy(update={"instrument": instrument}))


@pytest.mark.parametrize("factor", family([4.0, 2.0, 8.0], 1))
def test_tests_of_reference_values_use_the_noise_of_the_readings(factor: float) -> None:
    """Four times the declared noise: points that define axes, and control points, are tested as if it were declared."""
    recording = network(seed=6, stations=3)[0]
    sigma = recording.reading_sigmas()
    noisy = recording.with_readings(
        recording.readings + factor * sigma * random_stream(6, "more").standard_normal(sigma.shape)
    )
    points = {name: mesh()[recording.targets.index(name)] for name in SIX}
    points[SIX[0]] = points[SIX[0]] + np.array([0.0, 0.0, 1e-5 * factor])
    tests = [
        adjust(with_axes_from_points(each, points, "hall.csv")) for each in (noisy, with_declared_noise(noisy, factor))
    ]
    point_tests, right = ({test.name: test for test in a.axes_point_tests} for a in tests)
    assert tests[0].sigma0 > 0.8 * factor
    assert not any(test.is_excluded for test in point_tests.values())
    for name in SIX:
        assert point_tests[name].normalised_error == pytest.approx(right[name].normalised_error, rel=0.25, abs=0.1)
    targets = dict(noisy.setup.targets)
    for name in SIX:
        reference = {"known_mm": tuple((1e3 * points[name]).tolist()), "known_sigma_mm": SIGMA}
        targets[name] = targets[name].model_copy(update=reference)
    controlled_noisy = noisy.replace(setup=noisy.setup.model_copy(update={"targets": targets}))
    reference_tests = [
        test for test in adjust(controlled_noisy, tested_reference_kinds=()).reference_tests if test.kind == "point"
    ]
    assert len(reference_tests) == len(SIX)
    assert reference_tests[0].declared_sigmas[0] == pytest.approx(factor * SIGMA * 1e-3, rel=0.2)


def test_a_sigma_in_millimetres_stays_in_millimetres_next_to_coordinates_in_metres(tmp_path: Path) -> None:
    (tmp_path / "list.csv").write_text("name,x_m,y_m,z_m,sigma_mm\nP1,4.5,11.25,0.25,0.1\nP2,1.5,1.25,0.5,0.2\n")
    np.testing.assert_allclose(read_points(tmp_path / "list.csv").coordinate_sigmas, np.outer([1e-4, 2e-4], np.ones(3)))


def test_control_points_of_a_table_have_weight(tmp_path: Path) -> None:
    recording = network(seed=8, stations=3)[0]
    lines = ["target,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm"]
    for name in SIX:
        x, y, z = 1e3 * mesh()[recording.targets.index(name)]
        lines.append(f"{name},{x},{y},{z + (5.0 if name == 'T20' else 0.0)},0.02,0.02,0.05")
    lines.append("T02,,,5900,1,1,0.05")
    file = tmp_path / "control.csv"
    file.write_text("\n".join(lines))
    adjustment = adjust(with_control_points(recording, file))
    assert [test.name for test in adjustment.rejected_references] == ["T20"]
    assert {test.name: test.declared_axes for test in adjustment.reference_tests}["T02"] == "z"
    assert "frame of the control points" in lt.adjust(with_control_points(recording, file)).frame
    file.write_text("target,x_mm,y_mm,z_mm\nT01,1,2,3\n")
    with pytest.raises(RecordError, match="has no standard deviation of T01"):
        with_control_points(recording, file)
    file.write_text("target,x_mm,y_mm,z_mm,sigma_mm\nX01,1,2,3,0.1\n")
    with pytest.raises(RecordError, match="none of the recording's targets"):
        with_control_points(recording, file)


def test_the_sigma_of_an_error_agrees_with_its_w() -> None:
    """`2.999 +- 0.014 mm (w = 695)` was printed: the components of the error were correlated."""
    error, covariance = np.array([3e-3, 1e-4, 0.0]), np.diag([1.4e-5, 1e-5, 1e-5]) ** 2
    covariance[0, 1] = covariance[1, 0] = 0.9 * 1.4e-5 * 1e-5
    for n in (1, 3):
        test = ReferenceTest(
            "point",
            "P05",
            "xyz"[:n],
            declared_sigmas=np.full(n, 1e-5),
            residual=error[:n],
            error=error[:n],
            error_sigmas=np.sqrt(np.diag(covariance)[:n]),
            chi2_drop=float(error[:n] @ np.linalg.solve(covariance[:n, :n], error[:n])),
            rank=n,
            error_length_sigma=length_sigma(error[:n], covariance[:n, :n]),
        )
        size, sigma = (float(text) for text in test.error_text.removesuffix(" mm").split(" +- "))
        match = re.search(r"\(w = ([0-9.]+)\)", test.sentence)
        assert (match is not None) == (n == 1), test.sentence
        if match is not None:
            assert size / sigma == pytest.approx(float(match[1]), rel=0.05)
        else:
            assert f"(chi2 = {test.chi2_drop:.0f} for 3 components)" in test.sentence


def test_each_component_of_a_reference_value_has_a_separate_w() -> None:
    recording = network(seed=8, stations=3)[0]
    targets = dict(recording.setup.targets)
    for name in SIX:
        place = 1e3 * mesh()[recording.targets.index(name)] + np.array([0.0, 0.0, 0.5 * (name == "T20")])
        targets[name] = targets[name].model_copy(update={"known_mm": tuple(place.tolist()), "known_sigma_mm": 0.02})
    adjusted = lt.adjust(recording.replace(setup=recording.setup.model_copy(update={"targets": targets})))
    entries = [entry for entry in adjusted.reference_values if entry.kind == "point" and entry.sigma_error]
    assert len(entries) == 3 * len(SIX)
    for entry in entries:
        assert entry.w == pytest.approx(abs(entry.error) / entry.sigma_error)
