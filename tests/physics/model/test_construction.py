"""Both constructions are exact in both directions, and speak of the same instrument."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import ModelError
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import from_polar, wrap_angle
from ltsim.physics.model.construction import (
    GeometricErrorModel,
    dh_construction,
    ideal_construction,
    make_construction,
    misalignment_construction,
)

CONSTRUCTIONS = {
    "misalignment": misalignment_construction(),
    "dh": dh_construction(),
    "dh-rich": dh_construction(4, 3),
}
every = pytest.mark.parametrize("name", CONSTRUCTIONS)
both = pytest.mark.parametrize("name", ["misalignment", "dh"])
seeds = st.integers(0, 1000)
few = settings(max_examples=6)


def room(seed: int, count: int = 40) -> tuple[Floats, Ints]:
    """Points (n, 3) over the whole working range of a tracker, and faces."""
    rng = random_stream(seed, "room")
    polar = rng.uniform([1.2, -np.pi, -0.96], [9.0, np.pi, 1.34], (count, 3))
    return from_polar(polar), np.arange(count) % 2 + 1


def drawn(made: GeometricErrorModel, seed: int, size: float = 1.0) -> Floats:
    sigma = np.array([p.prior_sigma for p in made.parameters])
    return size * sigma * random_stream(seed, "values").normal(size=made.n_parameters)


def across(raw: Floats) -> Floats:
    """Weights (n, 3, 1) that turn angles into lengths across the beam."""
    range_, elevation = raw[:, 0], raw[:, 2]
    return np.stack([np.ones(len(raw)), range_ * np.abs(np.cos(elevation)), range_], axis=1)[:, :, None]


def column(made: GeometricErrorModel, name: str, raw: Floats) -> Floats:
    """Change of the readings (3n,), in lengths, per unit of one parameter, at zero values."""
    design = made.reading_design(raw, np.zeros(made.n_parameters))[1] * across(raw)
    return np.ravel(design[:, :, made.parameter_index(name)])


@every
@pytest.mark.parametrize("size", [1.0, 10.0])
@given(seed=seeds)
@few
def test_point_of_reading_of_point_closes(name: str, size: float, seed: int) -> None:
    made = CONSTRUCTIONS[name]
    points, face = room(seed)
    values = drawn(made, seed, size)
    raw = made.readings_from_points(points, face, values)
    np.testing.assert_allclose(made.points_from_readings(raw, values), points, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", [*CONSTRUCTIONS, "steering-mirror", "ideal"])
@pytest.mark.parametrize("size", [0.0, 1.0, 10.0])
def test_readings_with_their_design_are_both_of_them(name: str, size: float) -> None:
    made = CONSTRUCTIONS.get(name) or make_construction(name)
    points, face = room(3)
    values = drawn(made, 3, size)
    raw, by_point, by_value = made.readings_and_design(points, face, values)
    np.testing.assert_allclose(raw, made.readings_from_points(points, face, values), rtol=0, atol=2e-13)
    np.testing.assert_allclose(made.points_from_readings(raw, values), points, rtol=0, atol=1e-12)
    for ours, alone in zip((by_point, by_value), made.reading_design(raw, values), strict=True):
        np.testing.assert_allclose(ours, alone, rtol=1e-9, atol=1e-10)


@every
@given(seed=seeds)
@few
def test_reading_of_point_of_reading_closes(name: str, seed: int) -> None:
    made = CONSTRUCTIONS[name]
    points, face = room(seed)
    values = drawn(made, seed)
    raw = made.readings_from_points(points, face, values)
    again = made.readings_from_points(made.points_from_readings(raw, values), face, values)
    change = again - raw
    change[:, 1] = wrap_angle(change[:, 1])
    np.testing.assert_allclose(change, 0, atol=1e-12)


@both
def test_each_face_is_read_on_its_side(name: str) -> None:
    made = CONSTRUCTIONS[name]
    points, face = room(5)
    raw = made.readings_from_points(points, face, drawn(made, 5))
    assert np.array_equal(np.abs(raw[:, 2]) > np.pi / 2, face == 2)
    assert np.all(np.abs(raw[:, 1]) <= np.pi)


@every
def test_values_may_differ_from_pointing_to_pointing(name: str) -> None:
    made = CONSTRUCTIONS[name]
    points, face = room(6)
    values = np.stack([drawn(made, i) for i in range(len(points))])
    raw = made.readings_from_points(points, face, values)
    alone = np.concatenate([made.readings_from_points(points[[i]], face[[i]], values[i]) for i in range(len(points))])
    np.testing.assert_allclose(raw, alone, atol=1e-12)


@both
@given(seed=seeds)
@few
def test_reading_design_by_parameters(name: str, seed: int) -> None:
    """Central differences; the stated simplification costs a share of the size of the errors, 1e-4."""
    made = CONSTRUCTIONS[name]
    points, face = room(seed, 6)
    values = drawn(made, seed)
    raw = made.readings_from_points(points, face, values)
    analytic = made.reading_design(raw, values)[1] * across(raw)
    for i, parameter in enumerate(made.parameters):
        step = np.zeros(made.n_parameters)
        step[i] = parameter.prior_sigma
        change = made.readings_from_points(points, face, values + step) - made.readings_from_points(
            points, face, values - step
        )
        change[:, 1] = wrap_angle(change[:, 1])
        numeric = change * across(raw)[:, :, 0] / (2 * parameter.prior_sigma)
        # A parameter without effect has no size of its own: the unit does, a metre or a radian over 1 m.
        size = max(float(np.abs(analytic[:, :, i]).max()), 1.0)
        rounding = 1e-14 * np.abs(points).max() / parameter.prior_sigma
        np.testing.assert_allclose(
            numeric, analytic[:, :, i], rtol=0, atol=2e-4 * size + rounding, err_msg=parameter.name
        )


@both
@given(seed=seeds)
@few
def test_reading_design_by_the_point(name: str, seed: int) -> None:
    made = CONSTRUCTIONS[name]
    points, face = room(seed, 6)
    values = drawn(made, seed)
    raw = made.readings_from_points(points, face, values)
    analytic = made.reading_design(raw, values)[0] * across(raw)
    for axis in range(3):
        move = 1e-4 * np.eye(3)[axis]
        change = made.readings_from_points(points + move, face, values) - made.readings_from_points(
            points - move, face, values
        )
        change[:, 1] = wrap_angle(change[:, 1])
        numeric = change * across(raw)[:, :, 0] / 2e-4
        np.testing.assert_allclose(numeric, analytic[:, :, axis], rtol=0, atol=2e-4)


PHYSICAL = [
    ("range-offset", +1, "T.dZ_0"),
    ("range-offset", +1, "J2.dZ_c"),
    ("range-scale", +1, "T.dZ_1"),
    ("transit-offset", -1, "J1.dX_c"),
    ("beam-offset-lateral", +1, "T.dX_0"),
    ("beam-offset-lateral", -1, "J1.dZ_c"),
    ("beam-offset-lateral", -1, "J2.dY_c"),
    ("beam-offset-vertical", +1, "T.dY_0"),
    ("beam-offset-vertical", +1, "J2.dX_c"),
    ("beam-tilt", +1, "J2.eX_c"),
    ("beam-tilt", +1, "T.dX_1"),
    ("transit-tilt", -1, "J1.eX_c"),
    ("transit-tilt", -1, "J2.eX_sin"),
    ("vertical-index", +1, "J2.eY_c"),
    ("vertical-index", +1, "J1.eZ_c"),
    ("vertical-index", +1, "T.dY_1"),
    ("azimuth-eccentricity-cos", -1, "J1.eY_cos"),
    ("azimuth-eccentricity-sin", -1, "J1.eY_sin"),
    ("azimuth-second-order-cos", -1, "J1.eY_cos2"),
    ("azimuth-second-order-sin", -1, "J1.eY_sin2"),
    ("elevation-eccentricity-cos", +1, "J2.eY_cos"),
    ("elevation-eccentricity-sin", +1, "J2.eY_sin"),
    ("elevation-second-order-cos", +1, "J2.eY_cos2"),
    ("elevation-second-order-sin", +1, "J2.eY_sin2"),
]
"""Each misalignment term, and every D-H coefficient that alone reproduces it."""


@pytest.mark.parametrize(("term", "sign", "coefficient"), PHYSICAL)
def test_a_misalignment_term_is_a_denavit_hartenberg_column(term: str, sign: int, coefficient: str) -> None:
    points, face = room(1, 200)
    raw = ideal_construction().readings_from_points(points, face, np.zeros(0))
    ours, theirs = column(misalignment_construction(), term, raw), column(dh_construction(), coefficient, raw)
    np.testing.assert_allclose(sign * theirs, ours, rtol=0, atol=1e-13 * np.abs(ours).max())


def test_every_misalignment_term_has_its_column() -> None:
    assert {term for term, _, _ in PHYSICAL} == set(misalignment_construction().parameter_names)


def test_both_constructions_agree_on_an_instrument_beyond_first_order() -> None:
    """All 16 terms at once, once under each name: what is left is the product of two errors."""
    points, face = room(2, 200)
    mis, den = misalignment_construction(), dh_construction()
    values, twin = drawn(mis, 2), np.zeros(den.n_parameters)
    for term, sign, coefficient in {row[0]: row for row in reversed(PHYSICAL)}.values():
        twin[den.parameter_index(coefficient)] = sign * values[mis.parameter_index(term)]
    ours, theirs = mis.readings_from_points(points, face, values), den.readings_from_points(points, face, twin)
    weight = across(ours)[:, :, 0]
    raw = ideal_construction().readings_from_points(points, face, np.zeros(0))
    assert np.abs((ours - raw)[:, 2] * weight[:, 2]).max() > 2e-5
    assert np.abs((ours - theirs) * weight).max() < 5e-9


def test_an_ideal_tracker_reads_polar_coordinates() -> None:
    points, face = room(3)
    raw = ideal_construction().readings_from_points(points, face, np.zeros(0))
    np.testing.assert_allclose(from_polar(raw), points, atol=1e-13)
    by_point, by_value = ideal_construction().reading_design(raw, np.zeros(0))
    assert by_value.shape == (len(raw), 3, 0)
    assert by_point.shape == (len(raw), 3, 3)


def test_no_pointing_at_all_is_no_special_case() -> None:
    none = np.zeros((0, 3))
    for made in CONSTRUCTIONS.values():
        assert made.readings_from_points(none, np.zeros(0, dtype=np.int64), np.zeros(made.n_parameters)).shape == (0, 3)
        assert made.reading_design(none, np.zeros(made.n_parameters))[1].shape == (0, 3, made.n_parameters)


@pytest.mark.parametrize(("harmonics", "degree", "size"), [(2, 2, 78), (0, 0, 18), (1, 1, 48), (4, 2, 126)])
def test_number_of_denavit_hartenberg_coefficients(harmonics: int, degree: int, size: int) -> None:
    made = dh_construction(harmonics, degree)
    assert made.n_parameters == size
    assert len(set(made.parameter_names)) == size


def test_names_are_looked_up_with_help() -> None:
    assert misalignment_construction().parameter_index(
        "beam-tilt"
    ) == misalignment_construction().parameter_names.index("beam-tilt")
    with pytest.raises(ModelError, match="did you mean beam-tilt"):
        misalignment_construction().parameter_index("beam-tilts")
    with pytest.raises(ModelError, match="did you mean dh"):
        make_construction("dhh")
    names = ["misalignment", "dh", "ideal"]
    assert [make_construction(name).name for name in names] == names
