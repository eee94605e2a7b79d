"""A diagnosis is the same whatever instructions the matrix library chooses for a processor."""

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
found = lt.diagnose(recording, held_out=True)
json.dump(found.content(), sys.stdout)
"""
"""A step between two pointings is the same at any moment between them: the evidence has a plateau."""
KERNELS = ("Nehalem", "Haswell")
RELATIVE_TOLERANCE = 1e-6
"""Of a figure; of probabilities, which screening in single precision enters, as a whole."""


def flat(content: Any, place: str = "") -> dict[str, Any]:
    """The figures and words of a result by their places."""
    if isinstance(content, dict):
        parts = [flat(value, f"{place}/{key}") for key, value in content.items()]
    elif isinstance(content, list):
        parts = [flat(value, f"{place}/{i}") for i, value in enumerate(content)]
    else:
        return {place: content}
    return {key: value for part in parts for key, value in part.items()}


@pytest.mark.long
def test_two_kernels_give_the_same_figures(root: Path) -> None:
    if not any(pool["internal_api"] == "openblas" for pool in threadpool_info()):
        pytest.skip("numpy does not compute with OpenBLAS here: its kernels cannot be chosen")
    figures = []
    for kernel in KERNELS:
        surroundings = {**os.environ, "OPENBLAS_CORETYPE": kernel, "PYTHONPATH": str(root)}
        done = subprocess.run(
            [sys.executable, "-c", CODE], env=surroundings, capture_output=True, text=True, check=True
        )
        figures.append(flat(json.loads(done.stdout)))
    first, other = figures
    assert first.keys() == other.keys()
    for key, value in first.items():
        if isinstance(value, float):
            chance = key.rpartition("/")[2] in ("probability", "p_same_scope", "p_value")
            assert value == pytest.approx(
                other[key], rel=RELATIVE_TOLERANCE, abs=RELATIVE_TOLERANCE if chance else 1e-9
            ), key
        else:
            assert value == other[key], key


def test_a_choice_among_equal_values_does_not_follow_rounding() -> None:
    values = np.array([1.0, 7.0, 7.0 + 1e-9, 7.0 - 1e-9, 2.0])
    rng = np.random.default_rng(1)
    for _ in range(20):
        rounded = values + 0.01 * NORMAL_EQUATIONS_TOLERANCE * rng.standard_normal(len(values))
        assert index_of_most_evidence(rounded) == 2
        assert indices_by_evidence(rounded).tolist() == [1, 2, 3, 4, 0]
    assert indices_by_evidence(np.array([])).tolist() == []
    assert indices_by_evidence(np.array([-np.inf, 0.0, -np.inf])).tolist() == [1, 0, 2]
