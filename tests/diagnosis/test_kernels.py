"""A result is the same whatever instructions the matrix library chooses for a processor."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.evidence import index_of_most_evidence, indices_by_evidence

CODE = """
import json, sys
import ltsim as lt

recording, _ = lt.simulate("paper-workshop", seed=20)
recording = recording.select((recording.station < 4) & (recording.target < 16))
recording, _ = lt.inject(recording, "range-step:S3", noncentrality=150, seed=3)
options = {"held_out": True} if sys.argv[1] == "diagnose" else {}
result = getattr(lt, sys.argv[1])(recording, **options)
json.dump(result.content(), sys.stdout)
"""
"""A step between two pointings is the same at any moment between them: the evidence has a plateau."""
KERNELS = ("Nehalem", "Haswell")
VERBS = ("check", "adjust", "calibrate", "diagnose")
RELATIVE_TOLERANCE = 1e-6
"""Relative, of a figure; of probabilities, which screening in single precision enters, as a whole."""
PROBABILITIES = ("probability", "p_same_scope", "p_value")
LARGEST_UNROUNDED = 1e5
"""Largest number that a calculation subtracts from another, to give zero up to rounding: 100 m in millimetres."""


def flat(content: Any, place: str = "") -> dict[str, Any]:
    """The figures and words of a result by their places."""
    if isinstance(content, dict):
        parts = [flat(value, f"{place}/{key}") for key, value in content.items()]
    elif isinstance(content, list):
        parts = [flat(value, f"{place}/{i}") for i, value in enumerate(content)]
    else:
        return {place: content}
    return {key: value for part in parts for key, value in part.items()}


def smallest_difference_that_counts(place: str, figures: dict[str, Any]) -> float:
    """Absolute difference at `place` that is rounding: of a zero, of the part of a sigma, of a correlation.

    A figure with a sigma may differ by `RELATIVE_TOLERANCE` of this sigma, and a covariance by `RELATIVE_TOLERANCE` of
    the product of two sigmas: smaller changes are not seen in any use of the result. Other figures may differ by the
    rounding of a number of `LARGEST_UNROUNDED`, which subtraction leaves in place of zero.
    """
    above, _, name = place.rpartition("/")
    rounding = float(np.finfo(float).eps) * LARGEST_UNROUNDED
    if name in PROBABILITIES:
        return RELATIVE_TOLERANCE
    if (
        name == "improvement_percent"
    ):  # 100 (1 - after / before), of two figures that may differ by `RELATIVE_TOLERANCE` each
        return 100 * RELATIVE_TOLERANCE
    sigma = figures.get(f"{above}/sigma")
    if name == "value" and isinstance(sigma, float):
        return max(rounding, RELATIVE_TOLERANCE * sigma)
    table, _, row = above.rpartition("/")
    variances = [figures.get(f"{table}/{i}/{i}") for i in (row, name)]
    if table.endswith("covariance") and all(isinstance(v, float) for v in variances):
        return RELATIVE_TOLERANCE * float(np.sqrt(np.prod(np.array(variances, dtype=float))))
    return rounding


def differences(first: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Places at which two contents differ by more than rounding."""
    assert first.keys() == other.keys()
    return [
        f"{place}: {value} and {other[place]}"
        for place, value in first.items()
        if (
            value
            != pytest.approx(other[place], rel=RELATIVE_TOLERANCE, abs=smallest_difference_that_counts(place, first))
            if isinstance(value, float) and isinstance(other[place], float)
            else value != other[place]
        )
    ]


@pytest.mark.long
@pytest.mark.parametrize("verb", VERBS)
def test_two_kernels_give_the_same_figures(verb: str, root: Path) -> None:
    if not any(pool["internal_api"] == "openblas" for pool in threadpool_info()):
        pytest.skip("numpy does not compute with OpenBLAS here: its kernels cannot be chosen")
    figures = []
    for kernel in KERNELS:
        surroundings = {**os.environ, "OPENBLAS_CORETYPE": kernel, "PYTHONPATH": str(root)}
        done = subprocess.run(
            [sys.executable, "-c", CODE, verb], env=surroundings, capture_output=True, text=True, check=True
        )
        figures.append(flat(json.loads(done.stdout)))
    assert not differences(*figures)


def test_a_difference_that_counts_is_noticed_and_rounding_is_not() -> None:
    first = flat({"value": 1e-9, "sigma": 1.0, "rms": 3.0, "x": 1e-22, "covariance": [[4.0, 1e-9], [1e-9, 9.0]]})
    assert not differences(first, first | {"/value": -1e-9, "/rms": 3.0 + 2e-6, "/x": -1e-20, "/covariance/0/1": 2e-9})
    for place, value in {"/value": 3e-6, "/rms": 3.00001, "/x": 1e-9, "/covariance/0/1": 1e-5, "/sigma": 1.1}.items():
        assert [text.split(":")[0] for text in differences(first, first | {place: value})] == [place]


def test_a_choice_among_equal_values_does_not_follow_rounding() -> None:
    values = np.array([1.0, 7.0, 7.0 + 1e-9, 7.0 - 1e-9, 2.0])
    rng = np.random.default_rng(1)
    for _ in range(20):
        rounded = values + 0.01 * NORMAL_EQUATIONS_TOLERANCE * rng.standard_normal(len(values))
        assert index_of_most_evidence(rounded) == 2
        assert indices_by_evidence(rounded).tolist() == [1, 2, 3, 4, 0]
    assert indices_by_evidence(np.array([])).tolist() == []
    assert indices_by_evidence(np.array([-np.inf, 0.0, -np.inf])).tolist() == [1, 0, 2]
