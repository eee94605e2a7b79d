"""Random streams that are keyed, never shared.

Whoever draws asks for a stream by what the draw is for: ``stream(seed, "truth", "beam-tilt", 17)``. A draw
depends on its key alone, so neither the number of workers nor the list of effects can change it.
"""

from __future__ import annotations

import zlib
from functools import lru_cache

import numpy as np

from ltsim.arrays import Floats, Ints

WORD = 2**32
BLOCK = 256
"""Trials whose numbers come from one stream; part of what the numbers are, so it never changes."""


@lru_cache(maxsize=4096)
def _number(name: str) -> int:
    return zlib.crc32(name.encode())


def stream(seed: int, *key: str | int) -> np.random.Generator:
    """Give the generator that belongs to `key` under the root `seed`.

    Parameters
    ----------
    seed : int
        Root seed, 0 or larger.
    *key : str or int
        What the draw is for, from general to particular. Names are hashed by a stable checksum (CRC-32),
        integers (a trial's number) are used as they are.

    Returns
    -------
    numpy.random.Generator
        Independent of the stream of every other key.
    """
    spawn_key = tuple([_number(part) if isinstance(part, str) else part for part in key])
    if max(seed, *spawn_key) >= WORD:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=spawn_key))
    # What the sequence makes of seed and key, each a word, in a third of the time.
    words = np.array([seed, 0, 0, 0, *spawn_key], dtype=np.uint32)
    return np.random.default_rng(np.random.SeedSequence(words))


def trials_normal(seed: int, trials: Ints, size: int, *key: str | int) -> Floats:
    """Standard normal numbers (size, B) of trials (B,) for `key`: the same whichever trials are asked for together.

    `BLOCK` consecutive trials share a stream, which gives them their numbers one trial after the other.
    """
    blocks, rows = np.divmod(trials, BLOCK)
    numbers = np.empty((size, len(trials)))
    for block in np.unique(blocks).tolist():
        own = blocks == block
        drawn = stream(seed, *key, *((block,) if block else ())).standard_normal((int(rows[own].max()) + 1, size))
        if own.all() and len(drawn) == len(trials):
            return drawn.T if np.array_equal(rows, np.arange(len(rows))) else drawn[rows].T
        numbers[:, own] = drawn[rows[own]].T
    return numbers
