"""Campaigns: many trials over a grid of settings, run fast, kept safely, summarised by queries."""

from importlib.util import find_spec

from ltsim.errors import missing_extra

PACKAGES = ("duckdb", "numba", "pyarrow")
"""What only campaigns need: a third of a whole installation."""


def require_packages() -> None:
    """Raise SetupError, saying what to install, where a package is missing that campaigns need."""
    if any(find_spec(name) is None for name in PACKAGES):
        raise missing_extra("campaigns", "campaigns")
