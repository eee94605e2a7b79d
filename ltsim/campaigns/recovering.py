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
        How many recordings to simulate.
    method, with_effects
        Of ltsim's calibrator, as of `calibrate`.
    construction : str, optional
        Of ltsim's calibrator; by default that of the scenario.
    calibrator : callable or str, optional
        One of your own, checked beside ltsim's: a command ``CMD {recording} {out}`` that reads a recording and writes
        parameters as JSON; in Python also a function that takes a recording and gives value, sigma (or None) and unit
        of each parameter by name. Effects are named ``head-sag:sag``.
    tolerance : mapping of str to str, optional
        Within which 95 % of a parameter's errors should lie, as `2 urad` for `beam-tilt`; only such parameters are
        checked then.
    errors : {`drawn`, `stated`}, optional
        Errors drawn from the prior, or as the scenario states them; default stated where it does.
    seed : int
        Root of all draws. Trial N is that of `simulate` with this seed and places of its own (`per-trial`).
    jobs : int
        Processes to work with; functions run in this one.
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
