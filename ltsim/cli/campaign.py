"""`ltsim campaign`, `recover`: many trials over a grid of settings, and a check that what is injected is recovered."""

from __future__ import annotations

import os
import sys
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree.ElementTree import Element, SubElement, tostring

import typer

import ltsim as lt
from ltsim.campaigns import require_packages
from ltsim.cli import streams
from ltsim.cli.places import FILE, FOLDER, Force, check_writable
from ltsim.cli.simulate import ScenarioName
from ltsim.cli.terminal import ResultTerminal, Terminal
from ltsim.core.arguments import MOST_JOBS
from ltsim.core.errors import SetupError, StoppedError
from ltsim.recordings.files import write_text

if TYPE_CHECKING:
    from ltsim.campaigns.recovery import Recovery
    from ltsim.campaigns.results import Results


AGREED = 1e-3
"""[sigma] how far the batch may be from the full solver."""


CampaignFile = Annotated[Path | None, typer.Argument(metavar="FILE", help="A campaign file (ltsim-campaign/1).")]
Example = Annotated[bool, typer.Option("--show", help="Print a commented campaign file to edit, and do nothing else.")]
Rows = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder for the rows; default: FILE without its ending."),
    FOLDER,
]


def campaign(
    file: CampaignFile = None,
    show_example: Example = False,
    out: Rows = None,
    force: Force = False,
    *,
    terminal: Terminal,
    **options: Any,
) -> int:
    """Simulate, calibrate and judge many trials, safely: rows are kept whatever stops it, and --resume goes on.

    The rows are the same bytes for any number of jobs, any interruption and either backend, on processors of one type
    (the manifest names it). A cluster needs two commands: `dask scheduler --scheduler-file cluster.json` on one
    machine, `dask worker --scheduler-file cluster.json` on each that works; then --backend dask
    --scheduler cluster.json.

    A file that has grown since (further levels, trials, statistics) takes with --resume only what is missing.

    Exit status 1: the fast solver was more than 0.001 sigma from the full one on a trial that was verified.

    Example: ltsim campaign --show > mine.toml; ltsim campaign mine.toml --jobs 2
    """
    if show_example:
        terminal.show((files("ltsim.campaigns") / "example.toml").read_text(encoding="utf-8"))
        return 0
    if file is None:
        raise SetupError("a campaign needs a FILE; ltsim campaign --show prints one to edit")
    require_packages()
    # The compiler, the columns and the queries take a second to load: no other verb should wait for them.
    from ltsim.campaigns.campaign import Workers, run_campaign
    from ltsim.campaigns.kernels import compiled_before
    from ltsim.campaigns.results import Results
    from ltsim.campaigns.spec import load_campaign
    from ltsim.campaigns.store import Store
    from ltsim.reports.sections.campaign import campaign_section

    folder = out or file.with_suffix("")
    check_writable(folder, folder=True)
    settings, scenarios = load_campaign(file, options["changes"])
    total = settings.trials * len(settings.methods) * len(scenarios)
    workers = Workers(*(options.pop(name) for name in ("jobs", "backend", "scheduler")))
    if not compiled_before():
        terminal.note("compiling the solver, which takes half a minute: the first campaign of an installation does")
    try:
        with terminal.progress("trials", total) as advance:
            outcome = run_campaign(file, folder, progress=advance, workers=workers, force=force, **options)
    except KeyboardInterrupt:
        kept = len(Store(folder).shards())
        raise StoppedError(f"{kept} finished shards are kept in {folder}; go on with --resume") from None
    results = Results(folder)
    summary = results.summary()
    write_text(folder / "summary.csv", results.table("summary").csv())
    for note in outcome.notes:
        terminal.note(note)
    terminal.answer(summary)
    again = f", {outcome.kept} were finished before" if outcome.kept else ""
    terminal.say(f"{outcome.shards} shards written to {folder}{again}\n")
    if not terminal.silent:
        terminal.say(campaign_section(folder).text())
        terminal.say(f"\nall statistics: {folder / 'summary.csv'}; a page: ltsim report {folder}")
    failures = [disagreement(e, results) for e in summary["ends"] if (e["largest_difference_sigma"] or 0.0) > AGREED]
    for failure in failures:
        streams.write(failure, sys.stderr)
    return 1 if failures else 0


def disagreement(end: dict[str, Any], results: Results) -> str:
    """Sentence for status 1: the cell, its deviation and the limit."""
    cell = results.manifest.cells[end["cell"]].label
    return (
        f"cell {end['cell'] + 1} ({cell}), {end['method']}: the fast solver differs from the full one by up to "
        f"{end['largest_difference_sigma']:.2g} sigma on {end['checked']} verified trials, allowed {AGREED:g}; "
        'solver = "single" for the method calibrates every trial by the full one'
    )


RecoverJobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", "-j", min=1, max=MOST_JOBS, help="Processes to work with; default all cores, one for few trials."
    ),
]


JunitFile = Annotated[
    Path | None, typer.Option("--junit", metavar="FILE", help="Write the checks as JUnit XML too, for CI."), FILE
]
MODES = {"drawn": "drawn from the prior", "stated": "as the scenario states them"}
FEW = 100
"""Trials that take less time than starting further processes."""


def recover(
    scenario: ScenarioName,
    jobs: RecoverJobs = None,
    junit: JunitFile = None,
    *,
    terminal: ResultTerminal,
    **options: Any,
) -> None:
    """Make an instrument with errors, measure, calibrate, compare with the truth; many times.

    Errors are those that the scenario states, or drawn from the prior where it states none. Exit status 1, naming what
    fails: z-scores of every parameter (with drawn errors standard normal; with stated ones no wider, the value inside
    its interval as often as promised), chi-square, targets and stations. A parameter of your calibrator without a sigma
    or a tolerance is not checked, which is status 1 too. Writes recovery.json and trials.csv to --out.

    Example: ltsim recover paper-workshop --trials 1000 --jobs 2
    """
    from ltsim.campaigns.recovery_checks import FALSE_ALARM
    from ltsim.campaigns.schema import TRIALS, RecoveryFile

    terminal.claim(RecoveryFile, TRIALS.file)
    workers = jobs or (1 if options["trials"] < FEW else os.cpu_count() or 1)
    with terminal.progress("trials", options["trials"]) as step:
        result = lt.recover(scenario, progress=step, jobs=workers, **options)
    beside = {TRIALS.file: result.table("trials").csv()}
    checks = result.checks()
    content = RecoveryFile(
        passed=result.passed,
        errors=result.errors,
        trials=len(result.trials),
        converged=len(result.converged),
        seed=options["seed"],
        checks=tuple(checks),
        unchecked=result.unchecked(),
        problem=result.problem,
    )
    content = terminal.kept(content, lambda: beside)
    if junit is not None:
        write_text(junit, junit_xml(result, str(scenario)))
    terminal.answer(content.content())
    terminal.say(result.table("parameters").text() if len(result.converged) > 1 else "hardly a trial gave a result")
    for sentence in result.problems():
        streams.write(sentence, sys.stderr)
    if not result.passed:
        raise typer.Exit(1)
    rate = "" if result.tolerance else f" (a correct model fails this check in {100 * FALSE_ALARM:.0f} % of runs)"
    done = f"{len(result.trials)} trials, errors {MODES[result.errors]}"
    terminal.say(f"{done}: {result.verdict()}{rate}")


def junit_xml(result: Recovery, suite: str) -> str:
    """The checks as JUnit XML: a test case each, with value and limits; they share the time of all trials."""
    checks = result.checks()
    unchecked = result.unchecked()
    failed, each = sum(not check.passed for check in checks), f"{result.seconds / len(checks):.3f}"
    lost = 0 if result.allow_unchecked else len(unchecked)
    counts = {
        "tests": str(len(checks) + len(unchecked)),
        "failures": str(failed + lost),
        "errors": "0",
        "skipped": str(len(unchecked) - lost),
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
    for name in unchecked:
        case = SubElement(root, "testcase", classname=f"recover.{name}", name="not checked", time="0.000")
        SubElement(case, "failure" if lost else "skipped", message=f"{name} is not checked: no sigma in every trial")
    return tostring(root, encoding="unicode", xml_declaration=True) + "\n"
