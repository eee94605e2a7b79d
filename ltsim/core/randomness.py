"""Independent streams of random numbers; each stream has a key that names the purpose of its random numbers.

For example, ``random_stream(seed, "truth", "beam-tilt", 17)``. A random number depends only on the seed and the key,
and thus neither on the number of worker processes nor on the list of effects.
"""

import zlib
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ltsim.core.errors import InputError

SEED_UPPER_BOUND = 2**32
"""Upper bound of the integers in a seed: NumPy's SeedSequence takes unsigned integers of 32 bits."""
TRIALS_PER_STREAM = 256
"""Number of consecutive trials whose random numbers come from one stream. Another number would change all simulated
values."""
VALUES_PER_TRIAL_AND_BATCH = 4096
"""Number of values that are drawn at a time for each of the `TRIALS_PER_STREAM` trials of a stream; those of all trials
together take 8 MiB."""


@lru_cache(maxsize=4096)
def _key_checksum(key_text: str) -> int:
    """Integer in place of a name in the key of a random stream: the CRC-32 checksum of the name."""
    return zlib.crc32(key_text.encode())


def random_stream(seed: int, *stream_key: str | int) -> np.random.Generator:
    """Random generator of the stream with the key `stream_key` and the seed.

    Parameters
    ----------
    seed : int
        Root seed of all streams, 0 or larger.
    *stream_key : str or int
        Purpose of the draws, from general to particular. A name is replaced by its checksum (CRC-32); an integer, such
        as the number of a trial, is used as it is.

    Returns
    -------
    numpy.random.Generator
        Generator whose numbers are independent of the streams of all other keys.

    Raises
    ------
    InputError
        When the seed is negative.
    """
    if seed < 0:
        raise InputError(f"seed is {seed}, expected 0 or more")
    spawn_key = tuple([_key_checksum(part) if isinstance(part, str) else part for part in stream_key])
    if max(seed, *spawn_key) >= SEED_UPPER_BOUND:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=spawn_key))
    # The state that SeedSequence computes if seed and each part of the key are one 32-bit word, in a third of the time.
    words = np.array([seed, 0, 0, 0, *spawn_key], dtype=np.uint32)
    return np.random.default_rng(np.random.SeedSequence(words))


def standard_normal_trials(
    seed: int, trial_numbers: NDArray[np.int64], n_values: int, *stream_key: str | int
) -> NDArray[np.float64]:
    """Standard normal numbers of several trials, shape (n_values, trials), for the key `stream_key`.

    The numbers of a trial do not depend on the other trials in `trial_numbers`. Trial 0 has a separate stream; all
    other trials share one stream in groups of `TRIALS_PER_STREAM` consecutive trials.
    """
    first, count = int(trial_numbers[0]), len(trial_numbers)
    if count == 1 and not first:
        return random_stream(seed, *stream_key).standard_normal((n_values, 1))
    stream_numbers, stream_columns = np.divmod(trial_numbers, TRIALS_PER_STREAM)
    if np.array_equal(trial_numbers, TRIALS_PER_STREAM * stream_numbers[0] + np.arange(TRIALS_PER_STREAM)):
        normal_numbers = _stream_of_trials(seed, int(stream_numbers[0]), *stream_key).standard_normal(
            (n_values, TRIALS_PER_STREAM)
        )
    else:
        normal_numbers = np.empty((n_values, count))
        for stream_number in np.unique(stream_numbers).tolist():
            in_stream = np.flatnonzero(stream_numbers == stream_number)
            generator = _stream_of_trials(seed, stream_number, *stream_key)
            for first_value in range(0, n_values, VALUES_PER_TRIAL_AND_BATCH):
                n_batch_values = min(VALUES_PER_TRIAL_AND_BATCH, n_values - first_value)
                batch = generator.standard_normal((n_batch_values, TRIALS_PER_STREAM))
                normal_numbers[first_value : first_value + n_batch_values, in_stream] = batch[
                    :, stream_columns[in_stream]
                ]
    if not trial_numbers.all():
        normal_numbers[:, trial_numbers == 0] = random_stream(seed, *stream_key).standard_normal((n_values, 1))
    return normal_numbers


def _stream_of_trials(seed: int, stream_number: int, *stream_key: str | int) -> np.random.Generator:
    """Random generator of stream number `stream_number`, which `TRIALS_PER_STREAM` consecutive trials share."""
    return random_stream(seed, *stream_key, "block", stream_number)
