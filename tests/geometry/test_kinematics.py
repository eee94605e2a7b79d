"""The chains against their slow twins: the printed matrices, multiplied out one pointing at a time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.geometry.kinematics import (
    DH_CHAIN,
    MISALIGNMENT_CHAIN,
    ElementaryMotion,
    KinematicChain,
    RotationStep,
    points_and_error_derivatives,
    points_from_raw_readings,
)
from ltsim.geometry.polar import from_polar, swap_front_and_raw

CHAINS = {"misalignment": MISALIGNMENT_CHAIN, "dh": DH_CHAIN}
QUARTER = np.pi / 2
both = pytest.mark.parametrize("name", CHAINS)


def error_keys_of(chain: KinematicChain) -> list[str]:
    return [motion.error_key for motion in chain if motion.error_key]


def readings(seed: int, count: int = 8) -> Floats:
    rng = random_stream(seed, "readings")
    polar = rng.uniform([1.0, -np.pi, -1.0], [9.0, np.pi, 1.2], (count, 3))
    return swap_front_and_raw(polar, rng.integers(1, 3, count))


def errors(chain: KinematicChain, seed: int, count: int = 8, size: float = 1e-2) -> dict[str, Floats]:
    rng = random_stream(seed, "errors")
    return {key: rng.normal(0, size, count) for key in error_keys_of(chain)}


def shift(x: float, y: float, z: float) -> Floats:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def turn(axis: str, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    block = {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }[axis]
    matrix = np.eye(4)
    matrix[:3, :3] = block
    return matrix


def misalignment_twin(raw: Floats, e: Mapping[str, float]) -> Floats:
    """The formula of `MISALIGNMENT_CHAIN`, bearing first."""
    head = shift(e["transit-offset"], 0, 0) @ turn("x", e["transit-tilt"])
    head = head @ turn("y", -(raw[2] + e["elevation"])) @ shift(0, e["beam-lateral"], e["beam-vertical"])
    c, range_ = e["beam-tilt"], raw[0] + e["range"]
    bearing = shift(e["standing-radial-x"], e["standing-radial-y"], e["standing-axial"])
    bearing = bearing @ turn("x", e["standing-tilt-x"]) @ turn("y", e["standing-tilt-y"])
    target = np.array([range_ * np.cos(c), range_ * np.sin(c), 0, 1])
    return (bearing @ turn("z", raw[1] + e["azimuth"]) @ head @ target)[:3]


def link(theta: float, d: float, a: float, alpha: float) -> Floats:
    """Equation (1) of Sensors 2021, 21, 7479."""
    return shift(0, 0, d) @ turn("z", theta) @ shift(a, 0, 0) @ turn("x", alpha)


def dh_twin(raw: Floats, e: Mapping[str, float]) -> Floats:
    """Equations (1), (2), (5), (8), Table 1 of Sensors 2021, 21, 7479; azimuth zero brought from +Y to +X."""

    def of(joint: str, kind: str) -> list[float]:
        return [e[f"{joint}.{kind}{axis}"] for axis in "XYZ"]

    def rotary(joint: str) -> Floats:
        x, y, z = of(joint, "e")
        return shift(*of(joint, "d")) @ turn("x", x) @ turn("y", y) @ turn("z", z)

    chain = link(raw[1] - QUARTER, 0, 0, -QUARTER) @ rotary("J1")
    chain = chain @ link(raw[2] - QUARTER, 0, 0, QUARTER) @ rotary("J2") @ link(-QUARTER, raw[0], 0, 0)
    x, y, z = of("T", "e")
    small = np.array([[1, -z, y, 0], [z, 1, -x, 0], [-y, x, 1, 0], [0, 0, 0, 1]])
    return (turn("z", -QUARTER) @ chain @ shift(*of("T", "d")) @ small @ [0, 0, 0, 1])[:3]


TWINS = {"misalignment": misalignment_twin, "dh": dh_twin}


@both
@given(seed=st.integers(0, 1000))
def test_without_errors_a_chain_is_polar_coordinates(name: str, seed: int) -> None:
    raw = readings(seed)
    np.testing.assert_allclose(points_from_raw_readings(CHAINS[name], raw, {}), from_polar(raw), atol=1e-14)


@both
@given(seed=st.integers(0, 1000))
def test_a_chain_is_the_product_of_its_printed_matrices(name: str, seed: int) -> None:
    chain, raw = CHAINS[name], readings(seed)
    amounts = errors(chain, seed)
    per_point = [
        TWINS[name](raw[i], {key: float(amount[i]) for key, amount in amounts.items()}) for i in range(len(raw))
    ]
    np.testing.assert_allclose(points_from_raw_readings(chain, raw, amounts), per_point, atol=1e-13)


@pytest.mark.long
@both
@given(seed=st.integers(0, 1000))
def test_derivatives_by_every_error(name: str, seed: int) -> None:
    chain, raw = CHAINS[name], readings(seed)
    amounts = errors(chain, seed)
    p, analytic = points_and_error_derivatives(chain, raw, amounts, set(error_keys_of(chain)))
    np.testing.assert_array_equal(p, points_from_raw_readings(chain, raw, amounts))
    step = 1e-5
    for key in error_keys_of(chain):
        after = points_from_raw_readings(chain, raw, amounts | {key: amounts[key] + step})
        before = points_from_raw_readings(chain, raw, amounts | {key: amounts[key] - step})
        np.testing.assert_allclose(analytic[key], (after - before) / (2 * step), atol=1e-8, err_msg=key)


def test_an_error_used_twice_adds_up() -> None:
    chain: tuple[ElementaryMotion, ...] = (RotationStep(2, "twice"), *MISALIGNMENT_CHAIN, RotationStep(2, "nothing"))
    doubled = tuple(
        RotationStep(2, "twice", m.motion_amount_function) if m.error_key == "azimuth" else m for m in chain
    )
    raw = readings(3)
    _, by_key = points_and_error_derivatives(doubled, raw, {}, {"twice"})
    _, once = points_and_error_derivatives(MISALIGNMENT_CHAIN, raw, {}, {"azimuth"})
    np.testing.assert_allclose(by_key["twice"], 2 * once["azimuth"], atol=1e-14)


def test_only_wanted_errors_are_derived() -> None:
    _, by_key = points_and_error_derivatives(DH_CHAIN, readings(0), {}, {"J1.eX"})
    assert set(by_key) == {"J1.eX"}
