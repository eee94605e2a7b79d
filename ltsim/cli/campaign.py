"""`ltsim campaign`, `recover`: many trials over a grid of settings, and a check that what is injected is recovered."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from enum import StrEnum
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree.ElementTree import Element, SubElement, tostring

import typer

import ltsim as lt
from ltsim.campaigns import require_packages
from ltsim.cli.options import Out
from ltsim.cli.places import Force, claim, claim_file
from ltsim.cli.simulate import ScenarioName
from ltsim.cli.terminal import Terminal, table
from ltsim.errors import SetupError, StoppedError
from ltsim.recording.files import write_text
from ltsim.workers import MOST

if TYPE_CHECKING:
    from ltsim.campaigns.campaign import Outcome
    from ltsim.campaigns.recovery import Recovery
    from ltsim.campaigns.schema import RecoveryFile
    from ltsim.campaigns.statistics import Results
    from ltsim.results import Table


AGREED = 1e-3
"""[sigma] how far the batch may be from the full solver."""
SHOWN = (
    "distance_improvement_percent",
    "coordinate_improvement_percent",
    "share_removed",
    "target_error_um",
    "new_point_error_raw_um",
    "new_point_error_calibrated_um",
    "new_point_error_true_parameters_um",
)
MOST_ROWS = 48
"""Of a table of cells; more of them are told by their factors."""


class Backend(StrEnum):
    """Who works."""

    LOCAL = "local"
    DASK = "dask"


CampaignFile = Annotated[Path | None, typer.Argument(metavar="FILE", help="A campaign file (ltsim-campaign/1).")]
Example = Annotated[bool, typer.Option("--show", help="Print a commented campaign file to edit, and do nothing else.")]
Rows = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Folder for the rows; default: FILE without its ending.")
]
BackendName = Annotated[Backend, typer.Option(help="Processes on this machine, or workers of a dask cluster.")]
Scheduler = Annotated[
    str, typer.Option(metavar="ADDRESS", help="Of the dask scheduler, such as tcp://host:8786, or its cluster file.")
]


def campaign(
    file: CampaignFile = None,
    show_example: Example = False,
    out: Rows = None,
    backend: BackendName = Backend.LOCAL,
    scheduler: Scheduler = "",
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
        print((files("ltsim.campaigns") / "example.toml").read_text(encoding="utf-8"), end="")
        return 0
    if file is None:
        raise SetupError("a campaign needs a FILE; ltsim campaign --show prints one to edit")
    require_packages()
    # The compiler, the columns and the queries take a second to load: no other verb should wait for them.
    from ltsim.campaigns.campaign import Workers, run_campaign
    from ltsim.campaigns.kernels import compiled_before
    from ltsim.campaigns.spec import load_campaign
    from ltsim.campaigns.statistics import Results
    from ltsim.campaigns.store import Store

    folder = out or file.with_suffix("")
    settings, scenarios = load_campaign(file, options["changes"])
    total = settings.trials * len(settings.methods) * len(scenarios)
    workers = Workers(options.pop("jobs"), backend.value, scheduler)
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
    terminal.answer(summary)
    show(terminal, outcome, results, summary)
    failures = [disagreement(e, results) for e in summary["ends"] if (e["largest_difference_sigma"] or 0.0) > AGREED]
    for failure in failures:
        print(failure, file=sys.stderr)
    return 1 if failures else 0


def disagreement(end: dict[str, Any], results: Results) -> str:
    """What a status of 1 means: which cell, how far, and how far it may be."""
    cell = results.manifest.cells[end["cell"]].label
    return (
        f"cell {end['cell'] + 1} ({cell}), {end['method']}: the fast solver differs from the full one by up to "
        f"{end['largest_difference_sigma']:.2g} sigma on {end['checked']} verified trials, allowed {AGREED:g}; "
        'solver = "single" for the method calibrates every trial by the full one'
    )


def show(terminal: Terminal, outcome: Outcome, results: Results, summary: dict[str, Any]) -> None:
    """The answer in tables for a person: cell by cell, or of very many by their factors."""
    for note in outcome.notes:
        terminal.note(note)
    again = f", {outcome.kept} were finished before" if outcome.kept else ""
    terminal.say(f"{outcome.shards} shards written to {outcome.folder}{again}\n")
    names = " ".join(f.name for f in results.factors)
    ends, cells = (_worded(results, results.table(name)) for name in ("ends", "summary"))
    if len(ends.rows) > MOST_ROWS:
        trials, failed = (sum(ends.column(name)) for name in ("trials", "failed"))
        terminal.say(f"{len(results.levels)} cells, {trials} trials, {failed} failed\n")
        settings = [[f.words(level[f.name]) for f in results.factors] for level in results.levels]
        shown = [c for c in summary["columns"] if c["column"] in SHOWN]
        heads = ["factor", "level", "method", "statistic", "mean", "least cell", "largest cell"]
        terminal.say(table(heads, by_factor(names.split(), settings, shown), left=4))
    else:
        terminal.say(ends.only(f"{names} method trials failed by_full_solver checked largest_difference_sigma").text())
        at = cells.header.index("column")
        chosen = replace(cells, rows=tuple(row for row in cells.rows if row[at] in SHOWN))
        quantiles = "quantile_5_percent quantile_50_percent quantile_95_percent"
        terminal.say("\n" + chosen.only(f"{names} method column mean low high {quantiles}").text())
        terminal.say("low, high: 95 % confidence of the mean; quantiles are of the trials")
    terminal.say(f"\nall statistics: {outcome.folder / 'summary.csv'}; a page: ltsim report {outcome.folder}")


def _worded(results: Results, made: Table) -> Table:
    """A table of cells with their settings in words."""
    words = {f.name: f.words for f in results.factors}
    columns = tuple(replace(c, kind="text") if c.name in words else c for c in made.columns)
    rows = (
        tuple(words[c.name](value) if c.name in words else value for c, value in zip(columns, row, strict=True))
        for row in made.rows
    )
    return replace(made, columns=columns, rows=tuple(rows))


def by_factor(names: list[str], settings: list[list[str]], shown: list[dict[str, Any]]) -> list[list[str]]:
    """A row a level, method and statistic: means over the cells of the level."""
    groups: dict[tuple[str, str, str, str], list[float]] = {}
    for entry in shown:
        for name, level in zip(names, settings[entry["cell"]], strict=True):
            groups.setdefault((entry["column"], name, level, entry["method"]), []).append(entry["mean"])
    return [
        [name, level, method, column, *(f"{value:.3f}" for value in (sum(means) / len(means), min(means), max(means)))]
        for (column, name, level, method), means in groups.items()
    ]


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
    terminal.say(result.table("parameters").text() if len(result.converged) > 1 else "hardly a trial gave a result")
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
