"""The check that what is injected is recovered."""

from __future__ import annotations

from collections.abc import Callable

from ltsim.api.workshop import ScenarioSource, scenario
from ltsim.campaign.recovery import Recovery
from ltsim.campaign.recovery import recover as trials_of
from ltsim.errors import SetupError
from ltsim.model.construction import construction as construction_called
from ltsim.simulate.physics import construction_of


def recover(
    source: ScenarioSource,
    *,
    trials: int = 200,
    method: str = "network",
    construction: str | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Callable[[int], None] = lambda trials: None,
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
    own = construction_of(built)
    if own.name == "dh" and construction not in (None, "dh"):
        raise SetupError("the scenario's instrument is a dh one: recover with --construction dh")
    calibrator = own if construction is None else construction_called(construction)
    found = []
    for trial in trials_of(built, trials, seed=seed, jobs=jobs, method=method, construction=calibrator):
        found.append(trial)
        progress(1)
    return Recovery(calibrator.names_of(tuple(built.trackers)), tuple(found))
