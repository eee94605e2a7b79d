"""Where to put the tripod, and what to measure next."""

from __future__ import annotations

from pathlib import Path

from ltsim.planning.planner import Plan, make_plan
from ltsim.planning.spec import load_plan
from ltsim.remedies.next_measurement import Progress, next_measurement as next_measurement, quiet


def plan(
    source: str | Path = "paper-workshop",
    *,
    starts: int | None = None,
    seed: int | None = None,
    jobs: int = 1,
    progress: Progress = quiet,
) -> Plan:
    """Find a layout of stations and reflectors, with its reasons and its curve of cost against quality.

    Parameters
    ----------
    source : str or Path
        A plan file, a scenario file, or the name of a built-in one.
    starts : int, optional
        Independent searches; default as the file says.
    seed : int, optional
        Root of the search; default as the file says.
    jobs : int
        Processes; the plan does not depend on it.
    progress : callable
        Told what is done and the share of it.

    Raises
    ------
    SetupError
        In one sentence, for a plan that cannot be made.

    Examples
    --------
    >>> import ltsim as lt
    >>> made = lt.plan("small-plan.toml")
    >>> made.to_dataframe("stations").shape
    (3, 6)
    """
    file, scenario = load_plan(source)
    changes = {key: value for key, value in (("seed", seed), ("starts", starts)) if value is not None}
    file = file.model_copy(update={"search": file.search.model_copy(update=changes)})
    return make_plan(file, scenario, jobs=jobs, progress=progress)
