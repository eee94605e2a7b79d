"""Campaigns: many trials over a grid of settings, run fast, kept safely, summarised by queries."""

from ltsim.errors import require

PACKAGES = ("duckdb", "filelock", "numba", "pyarrow")
"""What only campaigns need: a third of a whole installation."""


def require_packages() -> None:
    """Raise SetupError, saying what to install, where a package is missing that campaigns need."""
    require(PACKAGES, "campaigns", "campaigns")
