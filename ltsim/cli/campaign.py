"""`ltsim campaign`: many trials over a grid of settings."""

from __future__ import annotations

import sys
from enum import StrEnum
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltsim.campaigns import require_packages
from ltsim.cli.places import Force
from ltsim.cli.terminal import Terminal, table
from ltsim.errors import SetupError, StoppedError
from ltsim.recording.files import write_text

if TYPE_CHECKING:
    from ltsim.campaigns.campaign import Outcome
    from ltsim.campaigns.statistics import Results

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
    from ltsim.campaigns.statistics import Results, summary_csv
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
    write_text(folder / "summary.csv", summary_csv(summary))
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
    settings = [[f.words(level[f.name]) for f in results.factors] for level in results.levels]
    names = [f.name for f in results.factors]
    shown = [c for c in summary["columns"] if c["column"] in SHOWN]
    if len(summary["ends"]) > MOST_ROWS:
        failed = sum(e["failed"] for e in summary["ends"])
        terminal.say(f"{len(settings)} cells, {sum(e['trials'] for e in summary['ends'])} trials, {failed} failed\n")
        heads = ["factor", "level", "method", "statistic", "mean", "least cell", "largest cell"]
        terminal.say(table(heads, by_factor(names, settings, shown), left=4))
    else:
        _by_cell(terminal, names, settings, summary["ends"], shown)
    terminal.say(f"\nall statistics: {outcome.folder / 'summary.csv'}; a page: ltsim report {outcome.folder}")


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


def _by_cell(
    terminal: Terminal,
    names: list[str],
    settings: list[list[str]],
    ends: list[dict[str, Any]],
    shown: list[dict[str, Any]],
) -> None:
    rows = [
        [
            *settings[e["cell"]],
            e["method"],
            *(str(e[key]) for key in ("trials", "failed", "by_full_solver", "checked")),
            "" if e["largest_difference_sigma"] is None else f"{e['largest_difference_sigma']:.1e}",
        ]
        for e in ends
    ]
    header = [*names, "method", "trials", "failed", "full solver", "verified", "largest difference [sigma]"]
    terminal.say(table(header, rows, left=len(names) + 1))
    rows = [
        [*settings[c["cell"]], c["method"], c["column"], f"{c['mean']:.3f}", f"{c['low']:.3f} to {c['high']:.3f}"]
        + ["" if c["quantiles"][k] is None else f"{c['quantiles'][k]:.2f}" for k in (1, 3, 5)]
        for c in shown
    ]
    if rows:
        heads = [*names, "method", "statistic", "mean", "95 % confidence", "5 %", "50 %", "95 %"]
        terminal.say("\n" + table(heads, rows, left=len(names) + 2))
