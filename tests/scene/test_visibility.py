from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ltsim.core.errors import ModelError
from ltsim.core.units import DEGREE
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.scene.visibility import (
    InvisibilityReason,
    SightLimits,
    compute_visibility,
    default_shadow_cone_opening,
    nest_normals_of_smallest_incidence,
    stand_shadow_radii,
)

HEAD = np.array([[0.0, 0.0, 2.0]])
LIMITS = SightLimits()


def at(elevation_deg: float, range_: float = 3.0) -> np.ndarray:
    """A target at an elevation and a range from the head, in direction +x."""
    e = elevation_deg * DEGREE
    return HEAD + range_ * np.array([[np.cos(e), 0.0, np.sin(e)]])


def reason(point: np.ndarray, limits: SightLimits = LIMITS) -> InvisibilityReason:
    return InvisibilityReason(int(compute_visibility(HEAD, point, limits).reason_codes[0, 0]))


@pytest.mark.parametrize(
    ("elevation", "expected"),
    [
        (-55.1, InvisibilityReason.BELOW_MIN_ELEVATION),
        (-54.9, InvisibilityReason.VISIBLE),
        (0.0, InvisibilityReason.VISIBLE),
        (76.9, InvisibilityReason.VISIBLE),
        (77.1, InvisibilityReason.ABOVE_MAX_ELEVATION),
    ],
)
def test_elevation_limits(elevation: float, expected: InvisibilityReason) -> None:
    assert reason(at(elevation)) == expected


def test_range_limits() -> None:
    limits = SightLimits(range_min=1.0, range_max=5.0)
    assert [reason(at(0.0, r), limits) for r in (0.9, 1.1, 4.9, 5.1)] == [
        InvisibilityReason.OUT_OF_RANGE,
        InvisibilityReason.VISIBLE,
        InvisibilityReason.VISIBLE,
        InvisibilityReason.OUT_OF_RANGE,
    ]


def test_a_limit_of_minus_55_hides_a_cone_of_70_degrees() -> None:
    assert default_shadow_cone_opening(-55 * DEGREE) == pytest.approx(70 * DEGREE)
    assert LIMITS.shadow_cone_opening == pytest.approx(70 * DEGREE)
    assert stand_shadow_radii(HEAD, 0.15, LIMITS.shadow_cone_opening)[0] == pytest.approx(1.85 * np.tan(35 * DEGREE))
    assert stand_shadow_radii(HEAD, 3.0, LIMITS.shadow_cone_opening)[0] == 0.0


def test_an_explicit_opening_keeps_a_wider_cone_free() -> None:
    wide = SightLimits(declared_shadow_cone_opening=110 * DEGREE)
    assert [reason(at(e), wide) for e in (-56.0, -40.0, -36.0, -34.0)] == [
        InvisibilityReason.BELOW_MIN_ELEVATION,
        InvisibilityReason.IN_STAND_SHADOW,
        InvisibilityReason.IN_STAND_SHADOW,
        InvisibilityReason.VISIBLE,
    ]


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.0, 1.5), st.floats(20, 120))
def test_shadow_circle_and_table_agree(x: float, y: float, z: float, opening_deg: float) -> None:
    limits = SightLimits(elevation_min=-90 * DEGREE, declared_shadow_cone_opening=opening_deg * DEGREE)
    radius = stand_shadow_radii(HEAD, z, limits.shadow_cone_opening)[0]
    distance = np.hypot(x, y)
    if abs(distance - radius) < 1e-6 or distance < 1e-6:
        return
    assert (reason(np.array([[x, y, z]]), limits) == InvisibilityReason.IN_STAND_SHADOW) == (distance < radius)


def test_limits_follow_a_leaning_instrument() -> None:
    lean = matrix_from_rotation_vector(np.array([[0.0, 10 * DEGREE, 0.0]]))
    table = compute_visibility(HEAD, at(-50.0), LIMITS, rotation=lean)
    assert table.elevations[0, 0] == pytest.approx(-40 * DEGREE)
    assert (
        compute_visibility(HEAD, at(-50.0), LIMITS, rotation=lean.transpose(0, 2, 1)).reason_codes[0, 0]
        == InvisibilityReason.BELOW_MIN_ELEVATION
    )


def test_acceptance_of_fixed_nests_only() -> None:
    normal = np.array([[-np.cos(31 * DEGREE), 0.0, np.sin(31 * DEGREE)]])
    fixed = compute_visibility(HEAD, at(0.0), LIMITS, nest_normals=normal, is_reaimed=np.array([False]))
    turned = compute_visibility(HEAD, at(0.0), LIMITS, nest_normals=normal, is_reaimed=np.array([True]))
    assert fixed.incidence_angles[0, 0] == pytest.approx(31 * DEGREE)
    assert fixed.reason_codes[0, 0] == InvisibilityReason.OUTSIDE_ACCEPTANCE_ANGLE and turned.is_visible[0, 0]


def test_unknown_nests_accept_every_beam() -> None:
    table = compute_visibility(
        HEAD, at(0.0), LIMITS, nest_normals=np.full((1, 3), np.nan), is_reaimed=np.array([False])
    )
    assert table.is_visible.all()


class Wall:
    """Hides everything beyond x = 1; nobody stands at x < -1."""

    def is_blocked(self, origins: np.ndarray, ends: np.ndarray) -> np.ndarray:
        assert len(origins) == len(ends)
        return np.asarray((origins[:, 0] < 1) & (ends[:, 0] > 1))

    def moved_to_surface(self, points):
        return points

    def is_setup_inside_body(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(points[:, 0] < -1)


def test_obstacles_and_stations_inside_them() -> None:
    stations = np.array([[0.0, 0.0, 2.0], [-2.0, 0.0, 2.0]])
    targets = np.array([[3.0, 0.0, 2.0], [0.0, 3.0, 2.0]])
    table = compute_visibility(stations, targets, LIMITS, obstacles=Wall())
    assert table.reason_codes.tolist() == [
        [InvisibilityReason.HIDDEN_BY_OBSTACLE, InvisibilityReason.VISIBLE],
        [InvisibilityReason.STATION_INSIDE_OBSTACLE] * 2,
    ]
    assert table.invisible_pair_sentences(("A", "B"), ("P", "Q"))[0] == "A does not see P: hidden by an obstacle"
    assert table.reason_texts()[0] == ["hidden by an obstacle", ""]


def test_nonsense_is_refused() -> None:
    with pytest.raises(ModelError, match="same position as a station"):
        compute_visibility(HEAD, HEAD, LIMITS)
    with pytest.raises(ModelError, match="points has shape"):
        compute_visibility(HEAD, np.zeros((2, 2)), LIMITS)


def test_aimed_normals_are_the_axes_of_the_narrowest_cones() -> None:
    rng = np.random.default_rng(5)
    stations, targets = rng.uniform(2, 6, (5, 3)), rng.uniform(-1, 0.5, (6, 3))
    normal, half = nest_normals_of_smallest_incidence(stations, targets)
    back = stations - targets[:, None]
    back /= np.linalg.norm(back, axis=2, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    tries = normal[:, None] + rng.normal(0, 0.05, (6, 3000, 3))
    tries /= np.linalg.norm(tries, axis=2, keepdims=True)
    worst = np.arccos(np.einsum("tck,tsk->tcs", tries, back).min(axis=2))
    assert np.all(half < worst.min(axis=1) + 1e-3)


def test_out_of_range_gives_the_number_the_limit_and_the_key() -> None:
    limits = SightLimits(range_min=1.0, range_max=5.0)
    points = np.array([at(0.0, 5.1)[0], at(0.0, 0.9)[0], at(77.1)[0]]).reshape(-1, 3)
    table = compute_visibility(HEAD, points, limits)
    assert table.reason_texts()[0] == [
        "out of range (5.10 m, expected 1 to 5 m: instrument.limits.range_max_mm)",
        "out of range (0.90 m, expected 1 to 5 m: instrument.limits.range_min_mm)",
        "above the elevation limit (77.1 deg, the maximum is 77 deg: instrument.limits.elevation_max_deg)",
    ]
    assert table.short_reason_texts()[0][:2] == ["out of range", "out of range"]
