"""`ltsim recover`: a check for continuous integration that what is injected is recovered."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree.ElementTree import Element, SubElement, tostring

import typer

import ltsim as lt
from ltsim.cli.calibrate import Method, MethodOption
from ltsim.cli.options import Out, Seed
from ltsim.cli.places import Force, claim, claim_file
from ltsim.cli.simulate import ScenarioName
from ltsim.cli.terminal import Terminal, table
from ltsim.workers import MOST

if TYPE_CHECKING:
    from ltsim.campaigns.recovery import Recovery
    from ltsim.campaigns.schema import RecoveryFile

Trials = Annotated[int, typer.Option("--trials", "-n", min=2, help="How many recordings to simulate.")]
ConstructionChoice = Annotated[
    str | None,
    typer.Option("--construction", metavar="NAME", help="Of the calibrator; default that of the scenario."),
]

RecoverJobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", "-j", min=1, max=MOST, help="Processes to work with; default all cores, one for few trials."
    ),
]


class ErrorsMode(StrEnum):
    """Which errors the instrument has."""

    DRAWN = "drawn"
    STATED = "stated"


ErrorsOption = Annotated[
    ErrorsMode | None,
    typer.Option(
        "--errors", help="Errors drawn from the prior, or as the scenario states them; default stated where it does."
    ),
]
JunitFile = Annotated[
    Path | None, typer.Option("--junit", metavar="FILE", help="Write the checks as JUnit XML too, for CI.")
]
MODES = {"drawn": "drawn from the prior", "stated": "as the scenario states them"}
FEW = 100
"""Trials that take less time than starting further processes."""


def recover(
    scenario: ScenarioName,
    trials: Trials = 200,
    method: MethodOption = Method.NETWORK,
    construction: ConstructionChoice = None,
    seed: Seed = 0,
    jobs: RecoverJobs = None,
    errors: ErrorsOption = None,
    junit: JunitFile = None,
    out: Out = None,
    force: Force = False,
    *,
    terminal: Terminal,
) -> None:
    """Make an instrument with errors, measure, calibrate, compare with the truth; many times.

    Errors are those that the scenario states, or drawn from the prior where it states none. Exit status 1, naming what
    fails: z-scores of every parameter (with drawn errors standard normal; with stated ones no wider, the value inside
    its interval as often as promised), chi-square, targets and stations. Writes recovery.json and trials.csv to --out.

    Example: ltsim recover paper-workshop-re-aimed --trials 1000 --jobs 2
    """
    from ltsim.campaigns.recovery import FALSE_ALARM
    from ltsim.campaigns.schema import RecoveryFile

    claim(out, RecoveryFile, ("trials.csv",), force=force)
    claim_file(junit, force=force)
    workers = jobs or (1 if trials < FEW else os.cpu_count() or 1)
    how: dict[str, Any] = {"method": method.value, "construction": construction, "seed": seed, "jobs": workers}
    how["errors"] = None if errors is None else errors.value
    with terminal.progress("trials", trials) as step:
        result = lt.recover(scenario, trials=trials, progress=step, **how)
    content = recovery_file(result, seed)
    if out is not None:
        from ltsim.recording.result_file import write_result

        content = write_result(out, content, {"trials.csv": trials_csv(result)})
    if junit is not None:
        junit.write_text(junit_xml(result, str(scenario)), encoding="utf-8")
    terminal.answer(content.content())
    terminal.say(recovery_table(result))
    failures = result.failures()
    for failure in failures:
        terminal.note(failure.sentence())
    if failures:
        raise typer.Exit(1)
    terminal.say(
        f"{trials} trials, errors {MODES[result.errors]}: everything is recovered within its stated uncertainty "
        f"(a correct model fails this check in {100 * FALSE_ALARM:.0f} % of runs)"
    )


def recovery_file(result: Recovery, seed: int) -> RecoveryFile:
    """The outcome for a program."""
    from ltsim.campaigns.schema import CheckEntry, RecoveryFile

    checks = result.checks()
    return RecoveryFile(
        passed=all(check.passed for check in checks),
        errors=result.errors,
        trials=len(result.trials),
        converged=len(result.converged),
        seed=seed,
        checks=tuple(CheckEntry(**vars(check), passed=check.passed) for check in checks),
    )


def junit_xml(result: Recovery, suite: str) -> str:
    """The checks as JUnit XML: a test case each."""
    checks = result.checks()
    failed = str(sum(not check.passed for check in checks))
    root = Element("testsuite", name=f"ltsim recover {suite}", tests=str(len(checks)), failures=failed, errors="0")
    for check in checks:
        case = SubElement(root, "testcase", classname=f"recover.{check.what}", name=check.statistic)
        if not check.passed:
            SubElement(case, "failure", message=check.sentence())
    return tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def trials_csv(result: Recovery) -> str:
    """z-scores of every parameter, chi-square and the network's mean squares, one row a trial."""
    from ltsim.campaigns.schema import trials_table

    return trials_table(result.names).text(
        [number, *trial.z, trial.chi2, trial.dof, trial.targets, trial.stations]
        for number, trial in enumerate(result.trials)
        if trial is not None
    )


def recovery_table(result: Recovery) -> str:
    """One row a parameter: z-scores and what is left of the prior."""
    if len(result.converged) < 2:
        return "fewer than two trials converged"
    import numpy as np

    z = result.z
    left = np.sqrt(np.mean([trial.sigma**2 for trial in result.converged], axis=0))
    rows = [
        [
            name,
            f"{z[:, i].mean():+.3f}",
            f"{z[:, i].std(ddof=1):.3f}",
            f"{100 * np.mean(np.abs(z[:, i]) < 1.959964):.1f} %",
            f"{left[i]:.2f}",
        ]
        for i, name in enumerate(result.names)
    ]
    return table(["parameter", "mean z", "std z", "95 % covers", "sigma/prior"], rows)
