"""`ltsim recover`: a check for continuous integration that what is injected is recovered."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree.ElementTree import Element, SubElement, tostring

import typer

import ltsim as lt
from ltsim.cli.options import Out
from ltsim.cli.places import Force, claim, claim_file
from ltsim.cli.simulate import ScenarioName
from ltsim.cli.terminal import Terminal, table
from ltsim.errors import SetupError
from ltsim.workers import MOST

if TYPE_CHECKING:
    from ltsim.campaigns.recovery import Recovery
    from ltsim.campaigns.schema import RecoveryFile

RecoverJobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", "-j", min=1, max=MOST, help="Processes to work with; default all cores, one for few trials."
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
    jobs: RecoverJobs = None,
    junit: JunitFile = None,
    out: Out = None,
    force: Force = False,
    *,
    terminal: Terminal,
    **options: Any,
) -> None:
    """Make an instrument with errors, measure, calibrate, compare with the truth; many times.

    Errors are those that the scenario states, or drawn from the prior where it states none. Exit status 1, naming what
    fails: z-scores of every parameter (with drawn errors standard normal; with stated ones no wider, the value inside
    its interval as often as promised), chi-square, targets and stations. Writes recovery.json and trials.csv to --out.

    Example: ltsim recover paper-workshop-re-aimed --trials 1000 --jobs 2
    """
    from ltsim.campaigns.recovery_checks import FALSE_ALARM
    from ltsim.campaigns.schema import TRIALS, RecoveryFile

    claim(out, RecoveryFile, (TRIALS.file,), force=force)
    claim_file(junit, force=force)
    if junit is not None:
        _make_folder(junit.parent)
    workers = jobs or (1 if options["trials"] < FEW else os.cpu_count() or 1)
    with terminal.progress("trials", options["trials"]) as step:
        result = lt.recover(scenario, progress=step, jobs=workers, **options)
    content = recovery_file(result, options["seed"])
    if out is not None:
        from ltsim.recording.result_file import write_result

        content = write_result(out, content, {TRIALS.file: result.table("trials").csv()})
    if junit is not None:
        junit.write_text(junit_xml(result, str(scenario)), encoding="utf-8")
    terminal.answer(content.content())
    terminal.say(recovery_table(result))
    failures = result.failures()
    for failure in failures:
        print(failure.sentence(), file=sys.stderr)
    if failures:
        raise typer.Exit(1)
    rate = "" if result.tolerance else f" (a correct model fails this check in {100 * FALSE_ALARM:.0f} % of runs)"
    done = f"{len(result.trials)} trials, errors {MODES[result.errors]}"
    terminal.say(f"{done}: everything is recovered within {result.what}{rate}")


def _make_folder(folder: Path) -> None:
    """The folder of a file that is written after all trials."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise SetupError(f"{folder}: cannot be made ({problem.strerror})") from None


def recovery_file(result: Recovery, seed: int) -> RecoveryFile:
    """The outcome for a program."""
    from ltsim.campaigns.schema import RecoveryFile

    checks = result.checks()
    return RecoveryFile(
        passed=all(check.passed for check in checks),
        errors=result.errors,
        trials=len(result.trials),
        converged=len(result.converged),
        seed=seed,
        checks=tuple(checks),
    )


def junit_xml(result: Recovery, suite: str) -> str:
    """The checks as JUnit XML: a test case each, with value and limits; they share the time of all trials."""
    checks = result.checks()
    failed, each = str(sum(not check.passed for check in checks)), f"{result.seconds / len(checks):.3f}"
    counts: dict[str, str] = {
        "tests": str(len(checks)),
        "failures": failed,
        "errors": "0",
        "time": f"{result.seconds:.3f}",
    }
    root = Element("testsuite", {"name": f"ltsim recover {suite}", **counts})
    for check in checks:
        case = SubElement(root, "testcase", classname=f"recover.{check.what}", name=check.statistic, time=each)
        inside = SubElement(case, "properties")
        for name in ("value", "low", "high"):
            SubElement(inside, "property", name=name, value=f"{getattr(check, name):.6g}")
        if not check.passed:
            SubElement(case, "failure", message=check.sentence())
    return tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def recovery_table(result: Recovery) -> str:
    """One row a parameter: its errors, beside ltsim's where another calibrator is checked, and its z-scores."""
    if len(result.converged) < 2:
        return "fewer than two trials gave a result"
    columns = result.parameters()
    heads = {"rms_error": "rms error", "ltsim_rms_error": "ltsim's", "mean_z": "mean z", "deviation_z": "sd of z"}
    shown = [name for name in ("parameter", "unit", *heads) if name in columns]
    cover = ["" if c != c else f"{100 * c:.1f} %" for c in columns["coverage_95"]]
    rows = [
        [value if isinstance(value, str) else "" if value != value else f"{value:.3g}" for value in row] + [covered]
        for row, covered in zip(zip(*(columns[name] for name in shown), strict=True), cover, strict=True)
    ]
    return table([*(heads.get(name, name) for name in shown), "95 % covers"], rows, left=2)
