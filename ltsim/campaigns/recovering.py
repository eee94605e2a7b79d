"""The check that what is injected is recovered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ltsim.campaigns.recovery import Errors, Recovery, errors_of, recover as trials_of
from ltsim.errors import SetupError, unknown_name
from ltsim.model.construction import construction as construction_called
from ltsim.simulation.physics import construction_of
from ltsim.simulation.verbs import ScenarioSource, scenario


def recover(
    source: ScenarioSource,
    *,
    trials: int = 200,
    method: str = "network",
    construction: str | None = None,
    errors: Errors | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Callable[[int], None] = lambda trials: None,
) -> Recovery:
    """Make an instrument with errors, measure, calibrate, compare with the truth; many times.

    Parameters
    ----------
    source : Scenario, str or Path
    trials : int
    method, construction
        As of `calibrate`; the construction is by default the scenario's.
    errors : str, optional
        `drawn` from the prior, or as the scenario has them `stated`; default the latter where it states any.
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
    >>> lt.recover("paper-workshop-re-aimed", trials=12).failures()
    []
    """
    built = scenario(source)
    own = construction_of(built)
    if own.name == "dh" and construction not in (None, "dh"):
        raise SetupError("the scenario's instrument is a dh one: recover with --construction dh")
    calibrator = own if construction is None else construction_called(construction)
    mode = errors or errors_of(built)
    if mode not in ("drawn", "stated"):
        raise unknown_name("mode of errors", mode, ("drawn", "stated"))
    found = []
    how: dict[str, Any] = {"method": method, "construction": calibrator, "errors": mode}
    for trial in trials_of(built, trials, seed=seed, jobs=jobs, **how):
        found.append(trial)
        progress(1)
    return Recovery(calibrator.names_of(tuple(built.trackers)), tuple(found), mode)
