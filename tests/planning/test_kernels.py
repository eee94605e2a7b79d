"""The same layouts are lost whatever linear algebra the processor gets: OpenBLAS has kernels for each type of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.families import family

KERNELS = ("Haswell", "Nehalem", "SkylakeX", "Zen")
ROOT = Path(__file__).resolve().parents[2]
DECISIONS = """
import json
import numpy as np
from ltsim.core.errors import NetworkError
from ltsim.planning.layout_scorer import LayoutScorer
from ltsim.planning.expected_precision import ExpectedPrecision
from tests.planning.fixtures import survey
from tests.planning.test_information import masks

made, found = survey(), {}
reducer = LayoutScorer(made)
for name, visible in {"whole": np.ones((5, 28), dtype=bool), **masks()}.items():
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(made.station_positions, made.station_yaws, is_visible=visible), np.arange(5)[None],
        with_target_errors=True,
    )
    try:
        ExpectedPrecision.from_survey(made.replace(is_visible=visible))
        slow = "determined"
    except NetworkError:
        slow = "lost"
    fast = np.isfinite(out.information_matrices).all() and np.isfinite(out.weighted_target_rms).all()
    found[name] = [slow, "determined" if fast else "lost"]
print(json.dumps(found))
"""


@pytest.mark.parametrize("kernel", family(KERNELS, 2))
def test_rank_is_the_same_under_every_kernel(kernel: str) -> None:
    environment = os.environ | {"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "error", "-c", DECISIONS]
    ended = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
    if ended.returncode < 0:
        pytest.skip(f"this processor does not run the instructions of {kernel}")
    assert ended.returncode == 0, ended.stderr
    content = json.loads(ended.stdout)
    assert content.pop("whole") == ["determined", "determined"]
    assert content
    assert all(decisions == ["lost", "lost"] for decisions in content.values()), content
