"""The tracker with a beam-steering mirror: against a ray reflected at a plane, and published first-order forms."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.calibration.network import calibrate_network
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError
from ltsim.geometry.polar import from_polar, swap_front_and_raw
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.physics.model.construction import declared_construction, make_construction, steering_mirror_construction
from ltsim.recordings.setup import Instrument
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import simulate
from tests.geometry.test_kinematics import readings
from tests.networks import network

MIRROR = steering_mirror_construction()


def values(**nominal: float) -> Floats:
    parameters = np.zeros(MIRROR.n_parameters)
    for name, value in nominal.items():
        parameters[MIRROR.parameter_index(name.replace("_", "-"))] = value
    return parameters


def reflected(raw: Floats, e: dict[str, float]) -> Floats:
    """A beam up from the base, met by a plane mirror: point and normal of the mirror, and a ray, no chain."""
    azimuth = matrix_from_rotation_vector(np.array([[0.0, 0.0, raw[1]]]))[0]
    start = np.array([e["beam-x"], e["beam-y"], 0.0])
    start = start + azimuth @ np.array([e["cover-forward"], e["cover-left"], 0.0])
    lean_x = matrix_from_rotation_vector(np.array([[e["beam-tilt-x"], 0.0, 0.0]]))[0]
    lean_y = matrix_from_rotation_vector(np.array([[0.0, e["beam-tilt-y"], 0.0]]))[0]
    beam = lean_x @ lean_y @ np.array([0.0, 0.0, 1.0])
    half = 0.25 * np.pi - 0.5 * (raw[2] + e["vertical-index"])
    tilted = matrix_from_rotation_vector(np.array([[0.0, 0.0, e["mirror-tilt"]]]))[0]
    turned = matrix_from_rotation_vector(np.array([[0.0, half, 0.0]]))[0]
    transit = matrix_from_rotation_vector(np.array([[e["transit-tilt"], 0.0, 0.0]]))[0]
    normal = azimuth @ transit @ turned @ tilted @ np.array([1.0, 0.0, 0.0])
    forward = np.array([e["transit-offset"], 0.0, 0.0])
    on_mirror = azimuth @ (forward + transit @ turned @ np.array([e["mirror-offset"], 0.0, 0.0]))
    # Where the ray meets the plane; what is left of the range runs in the reflected direction.
    length = (on_mirror - start) @ normal / (beam @ normal)
    hit = start + length * beam
    away = beam - 2.0 * (beam @ normal) * normal
    point: Floats = hit + (raw[0] + e["range-offset"] - length) * away
    return point


def test_the_chain_is_a_ray_reflected_at_a_plane() -> None:
    raw = readings(11, 12)
    names = [n for n in MIRROR.parameter_names if not n.startswith(("azimuth", "elevation", "range-scale"))]
    for seed in range(4):
        drawn = dict(zip(names, np.random.default_rng(seed).normal(0.0, 1e-2, len(names)), strict=True))
        parameters = values(**{name.replace("-", "_"): value for name, value in drawn.items()})
        expected = [reflected(row, drawn) for row in raw]
        np.testing.assert_allclose(MIRROR.points_from_readings(raw, parameters), expected, atol=1e-13)


def test_an_ideal_mirror_reads_range_azimuth_and_elevation() -> None:
    polar = np.random.default_rng(5).uniform([1.0, -np.pi, -1.0], [9.0, np.pi, 1.2], (8, 3))
    raw = swap_front_and_raw(polar, np.array([1, 2] * 4))
    np.testing.assert_allclose(
        MIRROR.points_from_readings(raw, np.zeros(MIRROR.n_parameters)), from_polar(polar), atol=1e-13
    )


def first_order(name: str, range_: Floats, azimuth: Floats, elevation: Floats) -> Floats:
    """Corrections (n, 3) of range, azimuth and elevation per unit, by the half of the zenith angle V.

    The mirror's tilt c / cos(V/2), the transit axis' i tan(V/2) and the leaning beam are those of Loser and Kyle; the
    offsets follow from the image of the beam: a mirror moved by f along its normal moves the image by 2 f.
    """
    zenith = 0.5 * np.pi - elevation
    half, zero = 0.5 * zenith, np.zeros_like(range_)
    c, s = np.cos(azimuth), np.sin(azimuth)
    across = 1.0 / (range_ * np.sin(zenith))
    return np.stack(
        {
            "range-offset": (zero + 1.0, zero, zero),
            "range-scale": (range_, zero, zero),
            "vertical-index": (zero, zero, zero + 1.0),
            "mirror-tilt": (zero, 1.0 / np.cos(half), zero),
            "transit-tilt": (zero, np.tan(half), zero),
            "beam-tilt-x": (zero, -c / np.sin(zenith), -s),
            "beam-tilt-y": (zero, -s / np.sin(zenith), c),
            "mirror-offset": (2.0 * np.sin(half), zero, -2.0 * np.cos(half) / range_),
            "transit-offset": (np.sin(zenith), zero, -2.0 * np.cos(half) ** 2 / range_),
            "cover-forward": (zero, zero, 1.0 / range_),
            "cover-left": (zero, across, zero),
            "beam-x": (zero, -s * across, c / range_),
            "beam-y": (zero, c * across, s / range_),
        }[name],
        axis=1,
    )


@pytest.mark.parametrize("name", [n for n in MIRROR.parameter_names if not n.startswith(("azimuth", "elevation"))])
def test_sensitivities_are_the_published_half_angle_forms(name: str) -> None:
    polar = np.random.default_rng(7).uniform([1.0, -np.pi, -0.9], [9.0, np.pi, 1.2], (20, 3))
    _, by_value = MIRROR.reading_design(polar, np.zeros(MIRROR.n_parameters))
    corrections = -by_value[:, :, MIRROR.parameter_index(name)]
    np.testing.assert_allclose(corrections, first_order(name, *polar.T), atol=1e-12)


def test_two_faces_tell_what_turns_with_the_head() -> None:
    """The base and the mirror's tilt move a point alike on both faces; the transit axis does not."""
    polar = np.array([[4.0, 0.7, 0.4]])
    for name, same in (("beam-tilt-x", True), ("beam-y", True), ("mirror-tilt", True), ("transit-tilt", False)):
        parameters = values(**{name.replace("-", "_"): 1e-5})
        front, back = (
            MIRROR.points_from_readings(swap_front_and_raw(polar, np.array([f])), parameters) for f in (1, 2)
        )
        assert (np.abs(front - back).max() < 1e-9) == same, name


def test_injected_misalignments_come_back_from_a_recording_that_states_its_mirror() -> None:
    scenario = load_scenario("paper-workshop-two-face")
    tracker = scenario.instrument.model_copy(update={"construction": "steering-mirror", "errors": {"draw": True}})
    recording, truth = simulate(scenario.model_copy(update={"instrument": tracker}), 4)
    assert recording.setup.instrument.construction == "steering-mirror"
    calibration = calibrate_network(recording, recommend_measurements=False)
    assert calibration.construction.name == "steering-mirror"
    true = np.array([truth.instrument_values[name] for name in calibration.construction.parameter_names])
    off = calibration.estimates[0] - true
    z2 = float(off @ np.linalg.solve(calibration.covariance, off))
    assert 5.6 < z2 < 46.8  # 21 degrees of freedom, 99.9 % of samples
    assert calibration.fit.p_value is not None and calibration.fit.p_value > 1e-3
    wrong = calibrate_network(recording, make_construction("misalignment"), recommend_measurements=False)
    assert wrong.fit.chi2 > calibration.fit.chi2 + 100


def test_two_constructions_in_a_network_are_not_mixed_silently() -> None:
    recording, _ = network(stations=3)
    mirror, head = Instrument(construction="steering-mirror"), Instrument()
    stations = {name: recording.station_setup(name) for name in recording.stations}
    stations[recording.stations[0]] = stations[recording.stations[0]].model_copy(update={"instrument": "M"})
    setup = recording.setup.model_copy(update={"instruments": {"M": mirror}, "instrument": head, "stations": stations})
    with pytest.raises(NetworkError, match="calibrate them separately"):
        declared_construction(recording.replace(setup=setup))
