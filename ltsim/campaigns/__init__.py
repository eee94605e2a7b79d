"""Campaigns: many simulated trials for each combination of factor levels, in batches, with rows that SQL can query."""

import os

from ltsim.core.errors import require_extra

CAMPAIGN_PACKAGES = ("duckdb", "filelock", "numba", "pyarrow")
"""Packages that only campaigns need (extra `campaigns`); they take a third of the disk space of a complete
installation."""


def require_campaign_packages() -> None:
    """Check that the packages that campaigns need are installed; InputError with the command that installs them."""
    require_extra(CAMPAIGN_PACKAGES, "campaigns", "campaigns")


# Numba reads a `.numba_config.yaml` in the working folder, which may be somebody else's, at every compilation. It may
# name a folder of compiled code, which is unpickled, or a library to load. What the environment says goes before it.
for _name in ("NUMBA_CACHE_DIR", "NUMBA_CACHE_LOCATOR_CLASSES", "NUMBA_CUDA_DRIVER"):
    os.environ.setdefault(_name, "")
