"""`ltsim campaign`: many trials over a grid of settings."""

from __future__ import annotations

from enum import StrEnum
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltsim.campaigns import require_packages
from ltsim.cli.options import Jobs
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
)


class Backend(StrEnum):
    """Who works."""

    LOCAL = "local"
    DASK = "dask"


def campaign(
    file: Annotated[Path | None, typer.Argument(metavar="FILE", help="A campaign file (ltsim-campaign/1).")] = None,
    show_example: Annotated[
        bool, typer.Option("--show", help="Print a commented campaign file to edit, and do nothing else.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for the rows; default: FILE without its ending.")
    ] = None,
    jobs: Jobs = 1,
    resume: Annotated[bool, typer.Option("--resume", help="Continue what the folder holds.")] = False,
    backend: Annotated[Backend, typer.Option(help="Processes on this machine, or workers of a dask cluster.")] = (
        Backend.LOCAL
    ),
    scheduler: Annotated[
        str,
        typer.Option(metavar="ADDRESS", help="Of the dask scheduler, such as tcp://host:8786, or its cluster file."),
    ] = "",
    force: Force = False,
    *,
    terminal: Terminal,
) -> int:
    """Simulate, calibrate and judge many trials, safely: rows are kept whatever stops it, and --resume goes on.

    The rows are the same bytes for any number of jobs, any interruption and either backend, on processors of one type
    (the manifest names it). A cluster needs two commands: `dask scheduler --scheduler-file cluster.json` on one
    machine, `dask worker --scheduler-file cluster.json` on each that works; then --backend dask
    --scheduler cluster.json.

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
    from ltsim.campaigns.spec import load_campaign
    from ltsim.campaigns.statistics import Results, summary_csv
    from ltsim.campaigns.store import Store

    folder = out or file.with_suffix("")
    settings, scenarios = load_campaign(file)
    total = settings.trials * len(settings.methods) * len(scenarios)
    workers = Workers(jobs, backend.value, scheduler)
    try:
        with terminal.progress("trials", total) as advance:
            outcome = run_campaign(file, folder, workers=workers, resume=resume, force=force, progress=advance)
    except KeyboardInterrupt:
        kept = len(Store(folder).shards())
        raise StoppedError(f"{kept} finished shards are kept in {folder}; go on with --resume") from None
    results = Results(folder)
    summary = results.summary()
    write_text(folder / "summary.csv", summary_csv(summary))
    terminal.answer(plain(summary))
    show(terminal, outcome, results, summary)
    worst = max((e["largest_difference_sigma"] or 0.0 for e in summary["ends"]), default=0.0)
    return 1 if worst > AGREED else 0


def plain(content: Any) -> Any:
    """The same without values that JSON does not have (they become null)."""
    if isinstance(content, dict):
        return {key: plain(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [plain(value) for value in content]
    if isinstance(content, float) and not abs(content) < float("inf"):
        return None
    return content


def show(terminal: Terminal, outcome: Outcome, results: Results, summary: dict[str, Any]) -> None:
    """The answer in tables for a person."""
    for note in outcome.notes:
        terminal.note(note)
    again = f", {outcome.kept} were finished before" if outcome.kept else ""
    terminal.say(f"{outcome.shards} shards written to {outcome.folder}{again}")
    terminal.say()
    settings = [[f.words(level[f.name]) for f in results.factors] for level in results.levels]
    names = [f.name for f in results.factors]
    ends = [
        [
            *settings[e["cell"]],
            e["method"],
            str(e["trials"]),
            str(e["failed"]),
            str(e["by_full_solver"]),
            str(e["checked"]),
            "" if e["largest_difference_sigma"] is None else f"{e['largest_difference_sigma']:.1e}",
        ]
        for e in summary["ends"]
    ]
    header = [*names, "method", "trials", "failed", "full solver", "verified", "largest difference [sigma]"]
    terminal.say(table(header, ends, left=len(names) + 1))
    rows = [
        [*settings[c["cell"]], c["method"], c["column"], f"{c['mean']:.3f}", f"{c['low']:.3f} to {c['high']:.3f}",
         f"{c['quantiles'][1]:.2f}", f"{c['quantiles'][3]:.2f}", f"{c['quantiles'][5]:.2f}"]
        for c in summary["columns"]
        if c["column"] in SHOWN
    ]  # fmt: skip
    if rows:
        terminal.say()
        heads = [*names, "method", "statistic", "mean", "95 % confidence", "5 %", "50 %", "95 %"]
        terminal.say(table(heads, rows, left=len(names) + 2))
    terminal.say(f"\nall statistics: {outcome.folder / 'summary.csv'}; a page: ltsim report {outcome.folder}")
