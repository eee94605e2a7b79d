"""Commands that test measurements: `check`, `accept`, `bench`, `compare`, `uncertainty`."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import ltsim as lt
from ltsim.cli.estimation_options import BenchOptions, CheckOptions, CompareOptions, UncertaintyOptions
from ltsim.cli.examples import example_file_content
from ltsim.cli.options import ReadingOptions, ReadingOptionsWithControl, RecordingArgument, ShowTemplateOption
from ltsim.cli.terminal import ResultFolderTerminal, Terminal, is_reader_gone
from ltsim.core.errors import InputError, NetworkError, RecordError
from ltsim.core.notation import align_columns
from ltsim.recordings.files import is_number
from ltsim.simulation.builtin import builtin_names

if TYPE_CHECKING:
    from ltsim.adjustment.fieldcheck import Check, CheckItem
    from ltsim.measurands.spec import Tasks
    from ltsim.recordings.epoch_coordinates import EpochCoordinates
    from ltsim.recordings.recording import Recording

TwoFaceLimitOption = Annotated[
    str | None,
    typer.Option(
        "--mpe",
        metavar="A,B",
        help="Limit of two-face differences as lengths, A um + B um per metre of range; default from the noise and the "
        "specification of the instrument.",
    ),
]
WatchOption = Annotated[
    bool, typer.Option("--watch", help="Follow a recording that grows, and report problems at once.")
]
AcceptanceFileArgument = Annotated[
    Path | None, typer.Argument(metavar="FILE", help="An acceptance file (ltsim-acceptance/1).")
]
BenchTableArgument = Annotated[Path, typer.Argument(metavar="FILE", help="A table of angle_deg,length_um,probe_um.")]
POLL_INTERVAL_S = 1.0
"""Time [s] between two looks at the files of a growing recording, to see whether they have changed."""


def check(
    source: RecordingArgument,
    mpe: TwoFaceLimitOption = None,
    watch: WatchOption = False,
    *,
    options: CheckOptions,
    reading_options: ReadingOptionsWithControl,
    terminal: ResultFolderTerminal,
) -> int:
    """Test a recording in the field (go or no-go): faces, gross errors, moved tripods, drift, level and scatter.

    One set-up is enough. Repeated and two-face measurements of a target are compared, after a fit of the instrument
    errors. Exit status 0 for go, 1 for no-go. Writes check.json, two_face.csv and the picture check.svg to --out.

    Example: ltsim check my-recording --mpe 20,6 --out my-check
    """
    from ltsim.adjustment.fieldcheck import Check

    terminal.check_overwrite(Check)
    mpe_limit = parse_mpe(mpe)

    def run_check() -> Check:
        return lt.check(reading_options.read(source, is_growing=True), mpe=mpe_limit, **options.arguments())

    if watch:
        watch_recording(terminal, run_check, wait_for_changes(source))
        return 0
    recording = reading_options.read_and_report(source, terminal)
    with terminal.show_progress("checking"):
        result = lt.check(recording, mpe=mpe_limit, **options.arguments())

    def check_picture() -> dict[str, str]:
        from ltsim.reports.style import svg_text  # most checks draw nothing

        return {"check.svg": svg_text(result.plot())}

    result = terminal.write_result(result, check_picture)
    terminal.print_result(result)
    return 0 if result.passed else 1


def parse_mpe(text: str | None) -> tuple[float, float] | None:
    """Limit A [um] + B [um/m] times the range of two-face differences as (A, B), from a text such as "20,6".

    None without a text. Raises RecordError unless A > 0 and B >= 0.
    """
    if text is None:
        return None
    limit_texts = [part.strip() for part in text.split(",")]
    if (
        len(limit_texts) != 2
        or not all(is_number(part) and float(part) >= 0 for part in limit_texts)
        or not float(limit_texts[0]) > 0
    ):
        raise RecordError(f"--mpe is {text}, expected A,B in um and um/m, for instance 20,6")
    return float(limit_texts[0]), float(limit_texts[1])


def wait_for_changes(source: Path) -> Iterator[None]:
    """Iterator that yields at once, and then each time a file of the recording `source` has changed."""
    last_states: tuple[tuple[str, int, int], ...] | None = None
    while True:
        states = _file_modification_states(source)
        if states != last_states:
            last_states = states
            yield
        time.sleep(POLL_INTERVAL_S)


def _file_modification_states(source: Path) -> tuple[tuple[str, int, int], ...]:
    """Name, size [byte] and time of the last change [ns] of each file of a recording."""
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    states = []
    for file in files:
        try:
            status = file.stat()
        except OSError:
            continue  # replaced between listing and looking
        states.append((file.name, status.st_size, status.st_mtime_ns))
    return tuple(states)


def watch_recording(terminal: Terminal, run_check: Callable[[], Check], changes: Iterator[None]) -> None:
    """Repeated check of a growing recording; prints each new failed test, and a sentence when all tests pass again.

    `run_check` reads and checks the recording; `changes` yields after each change of its files. If the recording cannot
    be read or checked yet, the reason is printed once and the check is repeated after the next change.
    """
    reported_failures: set[tuple[str, str, tuple[str, ...]]] = set()
    reported_reasons: set[str] = set()
    for _ in changes:
        try:
            result = run_check()
        except (RecordError, NetworkError) as problem:
            reason = re.sub(r"\d+", "", str(problem))  # the same reason in another row is not repeated
            if reason not in reported_reasons:
                terminal.print_note(f"waiting: {problem}")
            reported_reasons.add(reason)
            continue
        reported_reasons.clear()
        failed = [item for item in result.items if not item.passed]
        for item in failed:
            if _failed_test_key(item) not in reported_failures:
                terminal.print_unbuffered(
                    f"{len(result.arrays.recording)} pointings: NO-GO {item.sentence}", rings_bell=True
                )
        if (reported_failures and not failed) or not reported_failures.union(map(_failed_test_key, failed)):
            terminal.print_unbuffered(f"{len(result.arrays.recording)} pointings: {result.sentence}")
        reported_failures = set(map(_failed_test_key, failed))
        if is_reader_gone():
            return


def _failed_test_key(item: CheckItem) -> tuple[str, str, tuple[str, ...]]:
    """Station, kind and targets of a test, by which a failed test is recognised, so that it is printed once."""
    return item.station, item.kind, item.targets


def accept(
    file: AcceptanceFileArgument = None, show: ShowTemplateOption = False, *, terminal: ResultFolderTerminal
) -> int:
    """Predict acceptance tests of a tracker, or evaluate measured errors, against the limits of its specification.

    Measured errors are judged by ISO 14253-1. Exit status 0 if all tests are accepted, 1 if one is rejected or
    undecided (`judgement` in accept.json). Writes accept.json and accept.csv to --out.

    Example: ltsim accept my-tracker.toml --out acceptance
    """
    if show:
        terminal.print_always(example_file_content("acceptance.toml"))
        return 0
    if file is None:
        raise InputError("ltsim accept needs a FILE; ltsim accept --show prints a template")
    from ltsim.acceptance.files import AcceptanceFile

    terminal.check_overwrite(AcceptanceFile)
    with terminal.show_progress("evaluating the tests"):
        content = lt.accept(file)
    content = terminal.write_result(content)
    terminal.print_result(content)
    return int(content.judgement not in (None, "accepted"))


def bench(file: BenchTableArgument, *, options: BenchOptions, terminal: ResultFolderTerminal) -> None:
    """Estimate a reflector's range error over the angle of incidence from its bench test, with uncertainty.

    In the bench test a rotary table turns the reflector. The first harmonic of the probe readings is the eccentricity
    of the reflector on the table; it is removed from the lengths. Writes bench.json to --out.

    Example: ltsim bench my-reflector.csv --out my-reflector
    """
    from ltsim.adjustment.evaluation.bench import BenchFile

    terminal.check_overwrite(BenchFile)
    content = terminal.write_result(lt.bench(file, **options.arguments()))
    terminal.print_json(content.content())
    terminal.print_text(repr(content))
    terminal.print_text("\n" + content.table().text())
    terminal.print_folder(terminal.out)


LaterRecordingArgument = Annotated[
    Path, typer.Argument(metavar="REC2", help="The later recording, of the same points.")
]
TaskFileArgument = Annotated[Path | None, typer.Argument(metavar="FILE", help="A task file (ltsim-tasks/1).")]
SourceOverrideOption = Annotated[
    str | None, typer.Option("--source", metavar="REC", help="Recording or scenario in place of the source in FILE.")
]
ComparedResultsOption = Annotated[
    Path | None,
    typer.Option(
        "--against",
        metavar="FILE",
        help="Result file of another recording or instrument; results are compared by the normalised error E_n.",
    ),
]
NO_COMMON_RESULT_TEXT = "no result of the other file has the same task, name and unit"
"""Text if two result files of `uncertainty` contain no result with the same task, name and unit."""


def compare(
    source: RecordingArgument,
    second: LaterRecordingArgument,
    *,
    options: CompareOptions,
    reading_options: ReadingOptions,
    terminal: ResultFolderTerminal,
) -> int:
    """Report the points that moved between two recordings, with displacements and detection limits.

    Lists of coordinates with covariance can be compared too: adjustment results of gama-local, or CSV tables with a
    NAME.covariance.csv in the same folder.

    Writes comparison.json and displacements.csv to --out. Exit status 1 if a point moved.

    Example: ltsim compare january march --stable P1,P2,P3 --out my-comparison
    """
    from ltsim.measurands.comparison import Comparison
    from ltsim.recordings.coordinates import is_coordinate_file

    terminal.check_overwrite(Comparison)
    has_coordinate_lists = is_coordinate_file(source) or is_coordinate_file(second)
    first, later = (
        _coordinates_or_path(p, terminal, requires_sigmas=False)
        if has_coordinate_lists
        else reading_options.read_and_report(p, terminal)
        for p in (source, second)
    )
    with terminal.show_progress("comparing"):
        comparison = lt.compare(first, later, **options.arguments())
    comparison = terminal.write_result(comparison)
    terminal.print_result(comparison)
    return int(bool(comparison.moved_points))


def _coordinates_or_path(
    path: Path, terminal: Terminal, *, allows_fixed: bool = False, requires_sigmas: bool = True
) -> EpochCoordinates | Path:
    """Coordinates read from a list of coordinates, with its notes and size printed; otherwise the path itself.

    With `allows_fixed`, coordinates that define the frame may have the variance 0. Unless `requires_sigmas`, the list
    may have no standard deviations.
    """
    from ltsim.recordings.coordinates import is_coordinate_file, read_coordinates

    if not is_coordinate_file(path):
        return path
    coordinates = read_coordinates(path, allows_fixed=allows_fixed, requires_sigmas=requires_sigmas)
    terminal.print_notes(coordinates.notes)
    terminal.print_text(f"{coordinates.title}: {len(coordinates.names)} points along {', '.join(coordinates.axes)}")
    return coordinates


def uncertainty(
    file: TaskFileArgument = None,
    source: SourceOverrideOption = None,
    against: ComparedResultsOption = None,
    show: ShowTemplateOption = False,
    *,
    options: UncertaintyOptions,
    terminal: ResultFolderTerminal,
) -> int:
    """Evaluate the uncertainty of measured features: GUM and Monte Carlo, budget, conformity with tolerances.

    Writes uncertainty.json, uncertainty.csv and budget.csv to --out. Exit status 0 if all results with a tolerance are
    accepted, 1 if one is rejected or undecided.

    Example: ltsim uncertainty flange.toml --out my-uncertainty
    """
    if show:
        terminal.print_always(example_file_content("uncertainty.toml"))
        return 0
    if file is None:
        raise InputError("ltsim uncertainty needs a FILE; ltsim uncertainty --show prints a template")
    from ltsim.measurands.spec import load_tasks
    from ltsim.measurands.uncertainty import Uncertainty, normalised_errors_of_files
    from ltsim.recordings.result_file import read_result
    from ltsim.reports.sections import result_section

    terminal.check_overwrite(Uncertainty)
    tasks = load_tasks(file)
    if source is not None:
        tasks = tasks.model_copy(update={"source": source})
    seed = tasks.monte_carlo.seed if options.seed is None else options.seed
    recording = _data_of_tasks(terminal, tasks, file, seed, source_is_in_file=source is None)
    with terminal.show_progress("drawing trials"):
        content = lt.uncertainty(recording, tasks, **options.arguments())
    comparison = None if against is None else normalised_errors_of_files(content, read_result(against, Uncertainty))
    content = terminal.write_result(content)
    json_content = content.content()
    if comparison is not None:
        json_content["against"] = [{"result": name, "E_n": value} for name, value in comparison]
    terminal.print_json(json_content)
    terminal.print_text("\n" + result_section(content).terminal_text())
    if comparison is not None:
        headings, rows = (
            ["result", "E_n", ""],
            [[n, f"{v:.2f}", "" if abs(v) <= 1 else "differs"] for n, v in comparison],
        )
        text = (
            f"Comparison with the other file (results agree if |E_n| is at most 1):\n{align_columns(headings, rows)}"
            if comparison
            else NO_COMMON_RESULT_TEXT
        )
        terminal.print_text(f"\n{text}")
    terminal.print_folder(terminal.out)
    return int(any(r.conformity is not None and r.conformity.judgement != "accepted" for r in content.results))


def _data_of_tasks(
    terminal: Terminal, tasks: Tasks, file: Path, seed: int, *, source_is_in_file: bool
) -> Recording | EpochCoordinates | Path:
    """Data that the tasks evaluate: recording, simulated recording of a scenario, coordinates, or path of a result.

    `file` is the task file, `seed` that of the simulation. `source_is_in_file` is True if the task file names the
    source; its path is then relative to that file.
    """
    from ltsim.recordings.coordinates import is_coordinate_file

    name = tasks.source
    source_path = file.parent / name if source_is_in_file else Path(name)
    if name in builtin_names() or source_path.suffix == ".toml":
        scenario = name if name in builtin_names() else source_path
        recording, _ = lt.simulate(scenario, seed=seed)
        terminal.print_text(f"scenario {name}, simulated with seed {seed}")
        return recording
    if not source_path.exists():
        raise InputError(f"{file}: source is {source_path}, which is neither a recording nor a scenario")
    if is_coordinate_file(source_path):
        return _coordinates_or_path(source_path, terminal, allows_fixed=True)
    return ReadingOptions().read_and_report(source_path, terminal)
