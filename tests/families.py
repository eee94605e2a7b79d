"""Families of inputs that exercise the same code: a few members in every run, all of them in the long run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def family(values: Iterable[Any], ordinary: int = 1) -> list[Any]:
    """Parameters of a test; all but the first `ordinary` carry the mark `long`. A tuple holds several parameters."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*row, marks=[pytest.mark.long] * (i >= ordinary)) for i, row in enumerate(rows)]
