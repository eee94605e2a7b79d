"""The numbers of thirty commands are those of the committed file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.golden.commands import COMMANDS, NUMBERS, STATUS, written

AGREEMENT = 1e-8
"""Largest difference of a number, relative to the root mean square of its column: the linear algebra of the kernels
Nehalem, Haswell and SkylakeX differs by up to 1e-9.
"""
DIFFERENCES = {"nonlinearity_ratio": 1e-5, "largest_difference_sigma": 1e-4, "parameters[].sigma": 1e-6}
"""The same by the end of the key for numbers that are small differences of large ones: between an exact and a linear
result, between two solvers, and the width of a posterior by a sum over a grid.
"""


def test_thirty_commands_of_all_verbs_are_listed() -> None:
    assert len(COMMANDS) == 30
    assert set(STATUS) < set(COMMANDS)


def test_each_tolerance_belongs_to_a_number() -> None:
    """A renamed key would otherwise lose its tolerance, which is seen only on another processor."""
    keys = {key for columns in json.loads(NUMBERS.read_text("utf-8")).values() for key in columns}
    assert all(any(key.endswith(end) for key in keys) for end in DIFFERENCES)


@pytest.mark.long
def test_the_numbers_are_those_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If a change of the numbers is intended: ``python -m tests.golden.commands``, and say why in the commit."""
    monkeypatch.chdir(tmp_path)
    expected: dict[str, dict[str, Any]] = json.loads(NUMBERS.read_text("utf-8"))
    assert list(expected) == list(COMMANDS)
    differences = []
    for name, columns in written():
        assert columns.keys() == expected[name].keys(), name
        for key, values in columns.items():
            count, rms, weighted = expected[name][key]
            scale = [1.0, rms, rms * max(count, 1.0)]
            agreement = next((a for end, a in DIFFERENCES.items() if key.endswith(end)), AGREEMENT)
            if not np.all(np.abs(np.subtract(values, (count, rms, weighted))) <= agreement * np.array(scale)):
                differences.append(f"{name} {key}: {values}, expected {[count, rms, weighted]}")
    assert not differences
