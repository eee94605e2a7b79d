"""Settings of all tests: one thread, no windows, cached bytecode, the same random examples on every run."""

from __future__ import annotations

import os
import sys
from pathlib import Path

# Before numpy is imported for the first time: its thread pools read these once.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ["MPLBACKEND"] = "Agg"
os.environ["PYVISTA_OFF_SCREEN"] = "true"
# Tests start some hundred processes; without bytecode each compiles the package again, half of its time.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "ltsim", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow], database=None
)
settings.load_profile("ltsim")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder `shared` beside the checkout, with recordings that are not part of the project."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("there is no folder 'shared' beside the checkout: real recordings are not at hand")
    return folder


@pytest.fixture(autouse=True)
def no_notes_on_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command without notes that depend on the clock or on compiled code from earlier runs."""
    from ltsim.cli import terminal

    monkeypatch.setattr(
        terminal, "FIRST_PROGRESS_DELAY_S", 3600.0
    )  # tests of the progress shorten the delay themselves
    monkeypatch.setattr(terminal.Terminal, "print_note_on_compilation", lambda self: None)


FIRST_MODULES = ("tests/architecture/test_quality.py", "tests/campaigns/test_campaign.py")
"""Modules that start first: the type check takes a minute, and one process compiles the solver for all others."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order of the tests: the modules that start first, then all others in the order of their names."""
    items.sort(key=lambda item: not item.nodeid.startswith(FIRST_MODULES))
