"""`ltsim compare`, `uncertainty`: which points moved, and what a task on a recording is worth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.options import ReadingOptions, Source
from ltsim.cli.terminal import ResultTerminal, Terminal, table
from ltsim.errors import SetupError
from ltsim.simulation.builtin import builtin_names

if TYPE_CHECKING:
    from ltsim.recording.coordinates import Coordinates
    from ltsim.recording.recording import Recording
    from ltsim.tasks.spec import Tasks

Second = Annotated[Path, typer.Argument(metavar="REC2", help="The later recording, of the same points.")]
TaskFile = Annotated[Path, typer.Argument(metavar="FILE", help="A task file (ltsim-tasks/1).")]
TaskSource = Annotated[
    str | None, typer.Option("--source", metavar="REC", help="Recording or scenario instead of the file's own.")
]
Against = Annotated[
    Path | None,
    typer.Option("--against", metavar="FILE", help="Results of another recording or instrument: E_n of each result."),
]
NONE_ALIKE = "no result of the other file has the same task, name and unit"


def compare(
    source: Source,
    second: Second,
    *,
    reading: ReadingOptions,
    terminal: ResultTerminal,
    **options: Any,
) -> int:
    """Say which points moved between two recordings, by how much, and which motion could not have been seen.

    Two lists of coordinates with covariance are compared too: adjustment results of gama-local, or CSV tables with
    NAME.covariance.csv beside them.

    Writes comparison.json and displacements.csv to --out. Exit status 1 when a point moved.

    Example: ltsim compare january march --stable P1,P2,P3 --out my-comparison
    """
    from ltsim.recording.coordinates import holds_coordinates
    from ltsim.tasks.comparison import DISPLACEMENTS, Comparison

    terminal.claim(Comparison, DISPLACEMENTS.file)
    lists = holds_coordinates(source) or holds_coordinates(second)
    one, other = (_listed(p, terminal) if lists else reading.open(p, terminal) for p in (source, second))
    with terminal.busy("comparing"):
        found = lt.compare(one, other, **options)
    found = terminal.kept(found, lambda: {DISPLACEMENTS.file: found.table().csv()})
    terminal.result(found)
    return int(bool(found.moved))


def _listed(path: Path, terminal: Terminal) -> Coordinates | Path:
    """A list of coordinates, with what its reader decided and its size said."""
    from ltsim.recording.coordinates import holds_coordinates, read_coordinates

    if not holds_coordinates(path):
        return path
    found = read_coordinates(path)
    terminal.notes(found.notes)
    terminal.say(f"{found.title}: {len(found.names)} points along {', '.join(found.axes)}")
    return found


def uncertainty(
    file: TaskFile,
    source: TaskSource = None,
    against: Against = None,
    *,
    terminal: ResultTerminal,
    **options: Any,
) -> int:
    """Say how well the tasks of a file are known: GUM and Monte Carlo, budget, verdict.

    Writes uncertainty.json, uncertainty.csv and budget.csv to --out. Exit status 1 when a result fails its tolerance.

    Example: ltsim uncertainty flange.toml --out my-uncertainty
    """
    from ltsim.pages.sections import section_of
    from ltsim.recording.result_file import read_result
    from ltsim.tasks.files import BUDGET, RESULTS, UncertaintyFile, compared
    from ltsim.tasks.spec import load_tasks

    terminal.claim(UncertaintyFile, RESULTS.file, BUDGET.file)
    tasks = load_tasks(file)
    if source is not None:
        tasks = tasks.model_copy(update={"source": source})
    drawn = tasks.monte_carlo.seed if options["seed"] is None else options["seed"]
    recording = _recording(terminal, tasks, file, drawn, beside=source is None)
    with terminal.busy("drawing trials"):
        evaluation = lt.uncertainty(recording, tasks, **options)
    content = evaluation.content
    other = None if against is None else compared(content, read_result(against, UncertaintyFile))
    tables = [evaluation.table(name) for name in ("results", "budget")]
    content = terminal.kept(content, lambda: {table.file: table.csv() for table in tables})
    answer = content.content()
    if other is not None:
        answer["against"] = [{"result": name, "E_n": value} for name, value in other]
    terminal.answer(answer)
    terminal.say("\n" + section_of(content).text())
    if other is not None:
        head, rows = ["result", "E_n", ""], [[n, f"{v:.2f}", "" if abs(v) <= 1 else "differs"] for n, v in other]
        told = f"Against the other results (|E_n| up to 1 agrees):\n{table(head, rows)}" if other else NONE_ALIKE
        terminal.say(f"\n{told}")
    terminal.written(terminal.out)
    return int(any(r.conformity is not None and r.conformity.judgement == "rejected" for r in content.results))


def _recording(terminal: Terminal, tasks: Tasks, file: Path, seed: int, *, beside: bool) -> Recording:
    """The recording of the tasks; a scenario is measured once, virtually."""
    name = tasks.source
    place = file.parent / name if beside else Path(name)
    if name in builtin_names() or place.suffix == ".toml":
        chosen = name if name in builtin_names() else place
        recording, _ = lt.simulate(chosen, seed=seed)
        terminal.say(f"scenario {name}, measured once with seed {seed}")
        return recording
    if not place.exists():
        raise SetupError(f"{file}: source names {place}, which is neither a recording nor a scenario")
    return ReadingOptions().open(place, terminal)
