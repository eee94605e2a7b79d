"""A draw depends on its key alone."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ltsim.core.randomness import random_stream

# A name stands for its checksum, so a number can only meet it by being as large as one.
keys = st.lists(st.one_of(st.text(min_size=1, max_size=12), st.integers(0, 100_000)), min_size=1, max_size=4)
PINNED = [1836234670, 529267623, 403011501]


def draw(names: list[str], trial: int) -> dict[str, float]:
    """What a campaign's trial does: one stream an effect."""
    return {name: float(random_stream(7, "truth", name, trial).normal()) for name in names}


def test_another_effect_changes_no_draw() -> None:
    few = draw(["beam-tilt", "range-offset"], 3)
    many = draw(["air", "range-offset", "station-drift", "beam-tilt"], 3)
    assert {name: many[name] for name in few} == few


@pytest.mark.parametrize("workers", [1, 2, 6])
def test_workers_change_no_draw(workers: int) -> None:
    alone = [draw(["beam-tilt"], trial) for trial in range(6)]
    with ThreadPoolExecutor(workers) as pool:
        assert list(pool.map(draw, [["beam-tilt"]] * 6, range(6))) == alone


@given(keys, keys)
def test_streams_agree_exactly_when_their_keys_do(first: list[str | int], second: list[str | int]) -> None:
    a, b = random_stream(1, *first).integers(2**63, size=4), random_stream(1, *second).integers(2**63, size=4)
    assert np.array_equal(a, b) == (first == second)


def test_seeds_differ_and_zero_is_a_seed() -> None:
    values = [random_stream(seed, "noise").normal() for seed in (0, 1, 2)]
    assert len(set(values)) == 3
    assert random_stream(0, "noise").normal() == values[0]


def test_order_of_the_key_matters() -> None:
    assert random_stream(1, "a", "b").normal() != random_stream(1, "b", "a").normal()


def test_the_hash_of_a_name_is_the_same_on_every_machine() -> None:
    """Pinned: PCG64 of SeedSequence(5, spawn_key=(crc32('beam-tilt'), 17))."""
    assert random_stream(5, "beam-tilt", 17).integers(2**32, size=3).tolist() == PINNED


def test_two_streams_are_uncorrelated() -> None:
    first, second = random_stream(3, "noise", 0).normal(size=20_000), random_stream(3, "noise", 1).normal(size=20_000)
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(20_000)
