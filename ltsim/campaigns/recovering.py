"""The check that what is injected is recovered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from ltsim.calibration.verbs import wanted
from ltsim.campaigns.foreign import Calibrator, checked_command
from ltsim.campaigns.recovery import How, Recovery, errors_of, recover as trials_of, recovered
from ltsim.campaigns.recovery_checks import recovery_checks as recovery_checks
from ltsim.campaigns.schema import Errors
from ltsim.errors import SetupError, option, unknown_name
from ltsim.model.construction import construction as construction_called
from ltsim.simulation.physics import construction_of
from ltsim.simulation.verbs import ScenarioSource, scenario, simulate


def recover(
    source: ScenarioSource,
    *,
    trials: int = 200,
    method: str = "network",
    construction: str | None = None,
    with_effects: Sequence[str] = (),
    calibrator: Calibrator | None = None,
    tolerance: Mapping[str, str] | None = None,
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
    method, construction, with_effects
        Of ltsim's calibrator, as of `calibrate`; the construction is by default the scenario's.
    calibrator : callable or str, optional
        One of your own, checked in place of ltsim's: a function that takes a recording and gives value, sigma (or None)
        and unit of each parameter by name, or a command ``'CMD {recording} {out}'`` that writes them as JSON. Effects
        are named ``head-sag:sag``. ltsim's own result of the same recordings stands beside it.
    tolerance : mapping of str to str, optional
        ``{"beam-tilt": "2 urad"}``: 95 % of the errors lie within it. Only the parameters that it names are checked.
    errors : str, optional
        `drawn` from the prior, or as the scenario has them `stated`; default the latter where it states any.
    seed, jobs : int
        Trial N is ``lt.simulate(source, seed=seed, trial=N, geometry="per-trial")``; functions run in this process.
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
        raise SetupError(f"the scenario's instrument is a dh one: recover with {option('construction')} dh")
    mode = errors or errors_of(built)
    if mode not in ("drawn", "stated"):
        raise unknown_name("mode of errors", mode, ("drawn", "stated"))
    if isinstance(calibrator, str):
        checked_command(calibrator)
    seen = simulate(built, seed=seed).recording if with_effects else None
    named = [with_effects] if isinstance(with_effects, str) else with_effects
    how = How(
        method,
        own if construction is None else construction_called(construction),
        tuple(wanted(text, seen) for text in named if seen is not None),
        calibrator,
    )
    alone = calibrator is not None and not isinstance(calibrator, str)
    work = trials_of(built, trials, how, seed=seed, jobs=1 if alone else jobs, errors=mode)
    return recovered(work, progress, mode, tolerance or {})
