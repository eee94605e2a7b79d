"""Independent streams of random numbers, each addressed by a key that names its purpose.

For example, ``random_stream(seed, "truth", "beam-tilt", 17)``. A draw depends only on the seed and the key, so that
neither the number of worker processes nor the list of effects can change it.
"""

import zlib
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ltsim.core.errors import SetupError

SEED_UPPER_BOUND = 2**32
"""Upper bound of the integers in a seed: NumPy's SeedSequence takes unsigned integers of 32 bits."""
TRIALS_PER_STREAM = 256
"""Number of consecutive trials whose numbers come from one stream. It defines the numbers and must not change."""


@lru_cache(maxsize=4096)
def _key_checksum(key_text: str) -> int:
    """Integer for one part of a key: a checksum of a name."""
    return zlib.crc32(key_text.encode())


def random_stream(seed: int, *stream_key: str | int) -> np.random.Generator:
    """Random generator for the key `stream_key` and the seed.

    Parameters
    ----------
    seed : int
        Root seed, 0 or larger.
    *stream_key : str or int
        Purpose of the draw, from general to particular. Names are hashed by a stable checksum (CRC-32),
        integers (a trial's number) are used as they are.

    Returns
    -------
    numpy.random.Generator
        Independent of the stream of every other key.

    Raises
    ------
    SetupError
        When the seed is negative.
    """
    if seed < 0:
        raise SetupError(f"seed is {seed}, expected 0 or more")
    spawn_key = tuple([_key_checksum(part) if isinstance(part, str) else part for part in stream_key])
    if max(seed, *spawn_key) >= SEED_UPPER_BOUND:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=spawn_key))
    # The state that SeedSequence makes of seed and key if each is one word, in a third of the time.
    words = np.array([seed, 0, 0, 0, *spawn_key], dtype=np.uint32)
    return np.random.default_rng(np.random.SeedSequence(words))


def standard_normal_trials(
    seed: int, trial_numbers: NDArray[np.int64], n_values: int, *stream_key: str | int
) -> NDArray[np.float64]:
    """Standard normal numbers of several trials, shape (n_values, trials), for the key `stream_key`.

    The numbers of each trial are independent of the other trials in the call. Trial 0 uses the stream of the key alone.
    For all other trials, `TRIALS_PER_STREAM` consecutive trials share one stream.
    """
    first, count = int(trial_numbers[0]), len(trial_numbers)
    if (
        count == TRIALS_PER_STREAM
        and not first % TRIALS_PER_STREAM
        and np.array_equal(trial_numbers, np.arange(first, first + TRIALS_PER_STREAM))
    ):
        return _normals_of_stream(seed, first // TRIALS_PER_STREAM, n_values, *stream_key)
    if count == 1 and not first:
        return random_stream(seed, *stream_key).standard_normal((n_values, 1))
    blocks, places = np.divmod(trial_numbers, TRIALS_PER_STREAM)
    normal_numbers = np.empty((n_values, count))
    for block in np.unique(blocks).tolist():
        in_block = blocks == block
        normal_numbers[:, in_block] = _normals_of_stream(seed, block, n_values, *stream_key)[:, places[in_block]]
    return normal_numbers


def _normals_of_stream(seed: int, stream_number: int, n_values: int, *stream_key: str | int) -> NDArray[np.float64]:
    """Standard normal numbers of all trials that share one stream, shape (n_values, `TRIALS_PER_STREAM`)."""
    normal_numbers = random_stream(seed, *stream_key, "block", stream_number).standard_normal(
        (n_values, TRIALS_PER_STREAM)
    )
    if not stream_number:
        normal_numbers[:, 0] = random_stream(seed, *stream_key).standard_normal(n_values)
    return normal_numbers
