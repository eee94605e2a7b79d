"""Air: Ciddor's index, bent rays, and the gradient that a network absorbs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.core.arrays import Floats
from ltsim.physics.effects.air_gradient import AirGradient
from ltsim.physics.effects.air_layer import AirLayer
from ltsim.physics.effects.ciddor import refractive_index_decrease_per_kelvin, refractivity, saturation_vapour_pressure
from ltsim.physics.effects.heat_plume import HeatPlume
from ltsim.physics.effects.rays import integrated_reading_change, relative_index_decrease_per_kelvin
from ltsim.physics.effects.turbulence import Turbulence
from tests.physics.effects.scenes import corrections, lengths, remaining_signature, scene

SCENE = scene()
FLOOR = float(min(SCENE.target_points[:, 2].min(), SCENE.station_positions[:, 2].min()))


def index(temperature: float, pressure: float, humidity: float, nanometres: float = 633.0) -> float:
    return float(
        1.0 + refractivity(np.array(temperature), pressure=pressure, humidity=humidity, wavelength=nanometres * 1e-9)
    )


@pytest.mark.parametrize(
    ("nanometres", "expected"),
    [
        (321.456, 1.000283543),
        (500.0, 1.000273781),
        (633.0, 1.000271373),
        (1000.987, 1.000269038),
        (1500.8, 1.000268190),
    ],
)
def test_index_is_that_of_the_nist_calculator(nanometres: float, expected: float) -> None:
    """NIST Engineering Metrology Toolbox, Ciddor, 20 C, 101.325 kPa, 50 %, 450 umol/mol, to its last digit."""
    assert index(20.0, 101_325.0, 50.0, nanometres) == pytest.approx(expected, abs=6e-10)


@pytest.mark.parametrize(
    ("temperature", "pressure", "expected"),
    [(20.0, 8e4, 21458.0), (20.0, 1e5, 26824.4), (10.0, 1e5, 27774.7)],
)
def test_index_of_dry_air_is_that_of_the_paper(temperature: float, pressure: float, expected: float) -> None:
    """Ciddor 1996, table 1: 1e8 (n - 1) of dry air at 633 nm."""
    assert 1e8 * (index(temperature, pressure, 0.0) - 1) == pytest.approx(expected, abs=0.15)


def test_sensitivities_are_those_of_the_catalogue() -> None:
    """Per K, per hPa, per percent of humidity, at 20 C and at 27 C."""
    for temperature, kelvin, hectopascal, percent in ((20.0, -0.955, 0.268, -0.0085), (27.0, -0.922, 0.262, -0.0126)):
        assert -1e6 * refractive_index_decrease_per_kelvin(temperature) == pytest.approx(kelvin, abs=6e-4)
        step = index(temperature, 101_375.0, 50.0) - index(temperature, 101_275.0, 50.0)
        assert 1e6 * step == pytest.approx(hectopascal, abs=6e-4)
        step = index(temperature, 101_325.0, 50.5) - index(temperature, 101_325.0, 49.5)
        assert 1e6 * step == pytest.approx(percent, abs=6e-5)


def test_vapour_pressure_over_water() -> None:
    """IAPWS-IF97, table 35: 3536.58941 Pa at 300 K."""
    assert float(saturation_vapour_pressure(np.array(26.85))) == pytest.approx(3536.58941, rel=1e-8)


def test_gradient_bends_and_shortens_as_the_formula_says() -> None:
    """Upright station: -1/2 beta G d cos el, +beta G d (mean height - sensor)."""
    s = scene(lean=0.0)
    beta = refractive_index_decrease_per_kelvin(20.0)
    sensor = s.target_points[:, 2].mean()
    mean = 0.5 * (s.target_points[s.target, 2] + s.station_positions[s.station, 2])
    changes = corrections(AirGradient(), s)[:, :, 0]
    np.testing.assert_allclose(changes[:, 0], beta * s.range_ * (mean - sensor), rtol=3e-4)
    np.testing.assert_allclose(changes[:, 1], 0.0, atol=1e-18)
    np.testing.assert_allclose(changes[:, 2], -0.5 * beta * s.range_ * np.cos(s.elevation), rtol=3e-4)
    assert 1e6 * 0.5 * refractive_index_decrease_per_kelvin(27.0) * 8.0 == pytest.approx(3.7, abs=0.05)


def test_gradient_agrees_with_the_integrated_ray() -> None:
    """To 1e-4: by halves of opposite gradients, which leave out the second order of n(T)."""
    effect = AirGradient()
    step = np.array([0.2])
    exact = 0.5 * (effect.reading_change(SCENE, step) - effect.reading_change(SCENE, -step))
    linear = effect.design(SCENE)[:, :, 0] * step[0]
    np.testing.assert_allclose(exact, linear, rtol=1e-4, atol=1e-14)


def test_horizontal_gradient_bends_sideways() -> None:
    """The same integral along x: the azimuth of a level ray along y, and its range by the distance from the sensor."""
    beta, slope = relative_index_decrease_per_kelvin(), 0.05

    def change_by(slope: float) -> Floats:
        return integrated_reading_change(
            SCENE, lambda points: (slope * (points[:, 0] - 3.0), np.broadcast_to([slope, 0.0, 0.0], points.shape))
        )

    change = 0.5 * (change_by(slope) - change_by(-slope))
    _, lateral, up = SCENE.beam_vectors
    middle = 0.5 * (SCENE.target_points[SCENE.target, 0] + SCENE.station_positions[SCENE.station, 0])
    np.testing.assert_allclose(change[:, 0], -beta * slope * SCENE.range_ * (middle - 3.0), atol=1e-11)
    turned = 0.5 * beta * slope * SCENE.range_ * lateral[:, 0] / np.cos(SCENE.elevation)
    np.testing.assert_allclose(change[:, 1], turned, atol=1e-11)
    raised = 0.5 * beta * slope * SCENE.range_ * up[:, 0] * SCENE.face_sign
    np.testing.assert_allclose(change[:, 2], raised, atol=1e-11)


def test_network_absorbs_the_gradient_whole_and_neither_part_alone() -> None:
    """Nothing is left of bending and range together; much of either alone."""
    whole = AirGradient().design(SCENE)[:, :, 0]
    size = np.linalg.norm(lengths(SCENE, whole))
    assert np.linalg.norm(remaining_signature(SCENE, whole, scale=True)) < 1e-9 * size
    exact = AirGradient().reading_change(SCENE, np.array([0.1])) / 0.1
    assert np.linalg.norm(remaining_signature(SCENE, exact, scale=True)) < 1e-3 * size
    bending, range_ = whole * [0.0, 1.0, 1.0], whole * [1.0, 0.0, 0.0]
    remaining = [remaining_signature(SCENE, part, scale=True) for part in (bending, range_)]
    assert min(np.linalg.norm(rest) for rest in remaining) > 0.05 * np.linalg.norm(lengths(SCENE, bending))
    cosine = remaining[0] @ remaining[1] / np.linalg.norm(remaining[0]) / np.linalg.norm(remaining[1])
    assert cosine == pytest.approx(-1.0, abs=1e-9)


def test_sensor_on_the_head_leaves_a_scale_at_each_station() -> None:
    """beta G z_sensor."""
    room, head = (AirGradient(sensor=place).design(SCENE)[:, :, 0] for place in ("room", "head"))
    height = SCENE.station_positions[SCENE.station, 2] - SCENE.target_points[:, 2].mean()
    np.testing.assert_allclose(
        (room - head)[:, 0], -relative_index_decrease_per_kelvin() * height * SCENE.range_, atol=1e-15
    )
    np.testing.assert_allclose((head - room)[:, 1:], 0.0)
    assert np.linalg.norm(remaining_signature(SCENE, head, scale=True)) > 1e-8


def test_a_layer_lies_above_the_network_wherever_its_frame_is() -> None:
    """A network 430 m above its zero has the same candidates, and a search stays between their neighbours."""
    lifted = replace(
        SCENE,
        target_points=SCENE.target_points + [0.0, 0.0, 430.0],
        station_positions=SCENE.station_positions + [0.0, 0.0, 430.0],
    )
    here, there = AirLayer.candidates(SCENE), AirLayer.candidates(lifted)
    assert [e.width for e in here] == [e.width for e in there]
    np.testing.assert_allclose([e.height for e in here], [e.height for e in there], atol=1e-12)
    np.testing.assert_allclose(here[3].design(SCENE), here[3].design(lifted), atol=1e-13)
    tall = replace(SCENE, target_points=SCENE.target_points * [1.0, 1.0, 20.0])
    for effect in AirLayer.candidates(tall):
        low, high = AirLayer.shape_parameters[0].neighbouring_grid_interval(effect.height)
        assert low <= effect.height <= high


def test_wide_layer_is_a_gradient() -> None:
    """In the middle of a wide logistic the profile is linear with slope 1 / (4 width), about half its step."""
    width, height = 60.0, float(SCENE.target_points[:, 2].mean() - FLOOR)
    layer = AirLayer(height=height, width=width).design(SCENE)[:, :, 0] * 4 * width
    gradient = AirGradient().design(SCENE)[:, :, 0]
    layer[:, 0] += relative_index_decrease_per_kelvin() * 0.5 * 4 * width * SCENE.range_
    size = np.abs(gradient).max(axis=0)
    assert (np.abs(layer - gradient).max(axis=0) <= 1e-3 * size).all()


@pytest.mark.parametrize(
    "effect", [AirLayer(height=3.0, width=0.3), HeatPlume(("S1",), offset=(0.4, 0.2, 0.0), radius=0.25)], ids=repr
)
def test_integrated_ray_is_converged_and_agrees_with_first_order(effect: AirLayer | HeatPlume) -> None:
    step = np.array([0.05])
    kelvin = effect.temperature_field(SCENE)

    def field(points: Floats) -> tuple[Floats, Floats]:
        warm, gradient = kelvin(points)
        return step[0] * warm, step[0] * gradient

    coarse, fine = integrated_reading_change(SCENE, field), integrated_reading_change(SCENE, field, n_steps=256)
    mask = effect.pointing_indicator(SCENE)[:, None]
    linear = effect.design(SCENE) @ step
    size = np.abs(linear).max(axis=0)
    assert (np.abs(coarse - fine).max(axis=0) < 1e-3 * size + 1e-14).all()
    assert (np.abs(fine * mask - linear).max(axis=0) < 3e-3 * size).all()


def test_plume_in_the_path_shortens_the_range() -> None:
    """5 K over half a metre, 2.3 um (at 27 C, 2.4 um at 20 C)."""
    plume = HeatPlume((), ("T10",), radius=0.5 / np.sqrt(2 * np.pi))
    change = plume.design(SCENE)[:, 0, 0][SCENE.target == 9] * 5.0
    # The target sits in the middle of the ball: half of it is in the path.
    np.testing.assert_allclose(change, -0.5 * refractive_index_decrease_per_kelvin(20.0) * 5.0 * 0.5, rtol=1e-3)


def test_heat_near_the_station_bends_and_heat_near_the_target_does_not() -> None:
    """Weight (d - s)."""
    near = HeatPlume(("S1",), offset=(0.3, 0.3, 0.0), radius=0.25)
    far = HeatPlume((), ("T10",), offset=(0.3, 0.3, 0.0), radius=0.25)
    bend = [np.abs(lengths(SCENE, e.design(SCENE)[:, :, 0])[:, 1:]).max() for e in (near, far)]
    assert bend[0] > 3 * bend[1]


def test_turbulence_has_the_size_of_its_workshop() -> None:
    """40 um across at 2.5 m is C = 100 um^2/m^3."""
    nothing = np.zeros((len(SCENE), 3))
    variance = Turbulence().variance(SCENE, nothing, np.array([100e-12, 4e-12]))
    spread = lengths(SCENE, np.sqrt(variance))
    expected = 40e-6 * (SCENE.range_ / 2.5) ** 1.5
    np.testing.assert_allclose(spread[:, 1], expected, rtol=0.02)
    np.testing.assert_allclose(spread[:, 2], expected, rtol=0.02)
    np.testing.assert_allclose(spread[:, 0], 2e-6 * np.sqrt(SCENE.range_))
