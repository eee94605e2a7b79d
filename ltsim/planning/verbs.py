"""Where to put the tripod, and what to measure next."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ltsim.planning.files import opened
from ltsim.planning.making import Follower, make_plan
from ltsim.planning.planner import Plan
from ltsim.planning.whatif import Alternative, moved, without as places_without
from ltsim.remedies.next_measurement import Progress, next_measurement as next_measurement, quiet


def plan(
    source: str | Path = "paper-workshop",
    *,
    starts: int | None = None,
    seed: int | None = None,
    jobs: int = 1,
    progress: Progress = quiet,
    follower: Follower | None = None,
    move: Mapping[str, tuple[float, ...]] | None = None,
) -> Plan:
    """Find a layout of stations and reflectors, with its reasons and its curve of cost against quality.

    Parameters
    ----------
    source : str or Path
        A plan file, a scenario file, the name of a built-in one, or the folder of a plan.
    starts : int, optional
        Independent searches; default as the file says.
    seed : int, optional
        Root of the search; default as the file says.
    jobs : int
        Processes; the plan does not depend on it.
    progress : callable
        Told what is done and the share of it.
    follower : Follower, optional
        In place of `progress`: also hears how long it may take, and is given the best layout so far.
    move : mapping, optional
        Nothing is searched: the layout as it stands, with these stations at other places (x, y and z in mm; z may be
        left out).

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
    file, scenario = opened(source)
    if move is not None:
        return moved(file, scenario, move)
    changes = {key: value for key, value in (("seed", seed), ("starts", starts)) if value is not None}
    file = file.model_copy(update={"search": file.search.model_copy(update=changes)})
    return make_plan(file, scenario, jobs=jobs, follower=follower or Follower(progress))


def without_station(source: str | Path, station: str) -> tuple[Alternative, ...]:
    """What a layout is worth without a station, then with it at the best other places, all others as they are.

    Parameters
    ----------
    source : str or Path
        The folder of a plan, a plan file or a scenario; its stations are the layout.
    station : str
        The one that cannot stand where it is.

    Raises
    ------
    SetupError
        When there is no such station, or no place for it.
    """
    return places_without(*opened(source), station)
