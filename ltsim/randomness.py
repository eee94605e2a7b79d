"""Random streams that are keyed, never shared.

Whoever draws asks for a stream by what the draw is for: ``stream(seed, "truth", "beam-tilt", 17)``. A draw
depends on its key alone, so neither the number of workers nor the list of effects can change it.
"""

from __future__ import annotations

import zlib
from functools import lru_cache

import numpy as np

WORD = 2**32


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
