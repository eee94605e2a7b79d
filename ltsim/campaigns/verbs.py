"""Public function `campaign`: many simulated trials for each combination of factor levels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ltsim.campaigns import require_campaign_packages
from ltsim.core.arguments import check_mapping_argument, path_argument, path_of_file_or_built_in
from ltsim.core.errors import InputError

if TYPE_CHECKING:
    from ltsim.campaigns.results import CampaignResults


def campaign(
    source: str | Path | Mapping[str, Any],
    *,
    out: str | Path | None = None,
    jobs: int = 1,
    backend: str = "local",
    scheduler: str = "",
    resume: bool = False,
    force: bool = False,
    changes: Mapping[str, Any] | None = None,
) -> CampaignResults:
    """Simulation, calibration and evaluation of many trials for each combination of factor levels.

    An interrupted run can be continued.

    Parameters
    ----------
    source : str, Path or mapping
        Campaign file (ltsim-campaign/1), mapping with its content (without `format`), or folder of a finished campaign.
    out : str or Path, optional
        Folder for the rows; default the file's name without its suffix. Required if `source` is a mapping.
    jobs : int
        Number of worker processes on this machine; the rows do not depend on it. With dask the scheduler's workers are
        used.
    backend : {`local`, `dask`}
        Processes on this machine (`local`), or workers of a dask cluster (`dask`).
    scheduler : str
        Address of the dask scheduler, such as tcp://host:8786, or the file that the scheduler wrote.
    resume : bool
        True to continue the campaign in the folder. If levels, trials or statistics were added to the file, only the
        missing rows and columns are computed.
    force : bool
        True to start again in a folder that contains a campaign; its rows are deleted.
    changes : mapping, optional
        New values by key of the file, such as 200 for `trials`, or by dotted key of the scenario, such as 2 for
        `work.faces`.

    Returns
    -------
    CampaignResults
        Rows as tables for queries.

    Raises
    ------
    InputError
        If the file is not valid, the folder contains another campaign, or the extra `campaigns` is not installed.

    Examples
    --------
    >>> import ltsim as lt
    >>> results = lt.campaign(
    ...     {
    ...         "scenario": "paper-workshop",
    ...         "trials": 64,
    ...         "methods": [{"name": "network", "method": "network"}],
    ...     },
    ...     out="my-campaign",
    ... )
    >>> results.to_dataframe("solver_comparisons")[["method", "trials", "failed_trials"]]
        method  trials  failed_trials
    0  network      64              0
    """
    require_campaign_packages()
    from ltsim.campaigns.campaign import WorkerSettings, run_campaign
    from ltsim.campaigns.results import CampaignResults
    from ltsim.campaigns.store import MANIFEST_FILE_NAME

    workers = WorkerSettings(jobs, backend, scheduler)
    check_mapping_argument("changes", changes)
    tables = source if isinstance(source, Mapping) else None
    if tables is not None and out is None:
        raise InputError("a campaign without a file needs a folder for its rows: out=...")
    path = Path("the campaign") if isinstance(source, Mapping) else path_of_file_or_built_in(source)
    is_finished = tables is None and (path / MANIFEST_FILE_NAME).is_file()
    if is_finished and out is None and not (resume or force or changes):
        return CampaignResults(path)
    folder = rows_folder(path, out)
    run_campaign(
        path,
        folder,
        workers=workers,
        resume=resume,
        force=force,
        changes=changes,
        tables=tables,
    )
    return CampaignResults(folder)


def rows_folder(campaign_file: Path, out: str | Path | None) -> Path:
    """Folder for the rows of a campaign: `out`, by default the name of the file without its suffix."""
    if out is not None:
        return path_argument("out", out)
    return campaign_file.with_suffix("") if campaign_file.name else campaign_file
