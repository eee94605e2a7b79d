"""Many trials: campaigns over a grid of settings, and the check that what is injected is recovered."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ltsim.api.workshop import ScenarioSource, scenario
from ltsim.campaign.campaign import Progress, Workers, run_campaign
from ltsim.campaign.recovery import Recovery
from ltsim.campaign.recovery import recover as trials_of
from ltsim.campaign.statistics import Results
from ltsim.errors import SetupError
from ltsim.model.construction import construction as construction_called
from ltsim.recording.settings import to_toml
from ltsim.simulate.physics import construction_of


def campaign(
    source: str | Path | Mapping[str, Any],
    *,
    out: str | Path | None = None,
    jobs: int = 1,
    resume: bool = False,
    force: bool = False,
) -> Results:
    """Simulate, calibrate and judge many trials; the rows are kept in a folder whatever stops it.

    Parameters
    ----------
    source : str, Path or mapping
        A campaign file (ltsim-campaign/1), its tables, or the folder of a campaign that has run.
    out : str or Path, optional
        Folder for the rows; default the file's name without its ending. Needed where `source` is a mapping.
    jobs : int
        Processes; the rows do not depend on it.
    resume : bool
        Continue what the folder holds.
    force : bool
        Begin anew in a folder that holds a campaign; its rows are lost.

    Returns
    -------
    Results
        The rows as tables to query.

    Raises
    ------
    SetupError
        In one sentence, for a file that cannot be run or a folder that holds another campaign.

    Examples
    --------
    >>> import ltsim as lt
    >>> results = lt.campaign(
    ...     {
    ...         "format": "ltsim-campaign/1",
    ...         "scenario": "paper-workshop",
    ...         "trials": 64,
    ...         "methods": [{"name": "network", "method": "network"}],
    ...     },
    ...     out="my-campaign",
    ... )
    >>> results.to_pandas("ends")[["method", "trials", "failed"]]
        method  trials  failed
    0  network      64       0
    """
    if isinstance(source, Mapping):
        if out is None:
            raise SetupError("a campaign that is no file needs a folder for its rows: out=...")
        with TemporaryDirectory() as place:
            file = Path(place) / "campaign.toml"
            file.write_text(to_toml(_from_here(source)), encoding="utf-8")
            return _run(file, Path(out), jobs, resume=resume, force=force)
    path = Path(source)
    if path.is_dir():
        return Results(path)
    return _run(path, path.with_suffix("") if out is None else Path(out), jobs, resume=resume, force=force)


def _from_here(tables: Mapping[str, Any]) -> dict[str, Any]:
    """The tables with a scenario's file named from the root, since a file of them lies elsewhere."""
    named = Path(str(tables.get("scenario", "")))
    return {**tables, "scenario": str(named.resolve())} if named.is_file() else dict(tables)


def _run(file: Path, folder: Path, jobs: int, *, resume: bool, force: bool) -> Results:
    run_campaign(file, folder, workers=Workers(jobs), resume=resume, force=force)
    return Results(folder)


def recover(
    source: ScenarioSource,
    *,
    trials: int = 200,
    method: str = "network",
    construction: str | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress = lambda trials: None,
) -> Recovery:
    """Draw an instrument from its prior, measure, calibrate, compare with the truth; many times.

    Parameters
    ----------
    source : Scenario, str or Path
    trials : int
    method, construction
        As of `calibrate`; the construction is by default the scenario's.
    seed, jobs : int
    progress : callable
        Told of every trial that is done.

    Returns
    -------
    Recovery
        `failures()` lists the checks that fail; a correct model fails any in one run of a hundred.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.recover("paper-workshop", trials=12).failures()
    []
    """
    built = scenario(source)
    if built.instrument.construction == "dh" and construction not in (None, "dh"):
        raise SetupError("the scenario's instrument is a dh one: recover with --construction dh")
    calibrator = construction_of(built.instrument) if construction is None else construction_called(construction)
    found = []
    for trial in trials_of(built, trials, seed=seed, jobs=jobs, method=method, construction=calibrator):
        found.append(trial)
        progress(1)
    return Recovery(calibrator.names, tuple(found))
