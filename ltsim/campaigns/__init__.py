"""Campaigns: many simulated trials for each combination of factor levels, in batches, with rows that SQL can query."""

from ltsim.core.errors import require_extra

CAMPAIGN_PACKAGES = ("duckdb", "filelock", "numba", "pyarrow")
"""Packages that only campaigns need (extra `campaigns`); they take a third of the disk space of a complete
installation."""


def require_campaign_packages() -> None:
    """Check that the packages that campaigns need are installed; InputError with the command that installs them."""
    require_extra(CAMPAIGN_PACKAGES, "campaigns", "campaigns")
