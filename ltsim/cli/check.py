"""`ltsim check`, `accept`, `bench`: one instrument in the field, against its maker's limits, and its reflector."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.options import ReadingOptions, Source
from ltsim.cli.terminal import ResultTerminal, Terminal
from ltsim.errors import NetworkError, RecordError
from ltsim.recording.files import is_number

if TYPE_CHECKING:
    from ltsim.fieldcheck import Check, Item

MpeOption = Annotated[
    str | None,
    typer.Option(
        "--mpe",
        metavar="A,B",
        help="Limit of two-face differences as lengths, A um + B um/m of the range; default by the stated noise and "
        "what the maker guarantees.",
    ),
]
Watch = Annotated[bool, typer.Option("--watch", help="Follow a recording that grows; say at once what goes wrong.")]
AcceptFile = Annotated[Path, typer.Argument(metavar="FILE", help="An acceptance file (ltsim-acceptance/1).")]
BenchTable = Annotated[Path, typer.Argument(metavar="FILE", help="A table angle_deg,length_um,probe_um.")]
POLL = 1.0
"""[s] between two looks at the files of a recording that grows."""


def check(
    source: Source,
    mpe: MpeOption = None,
    watch: Watch = False,
    *,
    reading: ReadingOptions,
    terminal: ResultTerminal,
    **options: Any,
) -> int:
    """Go or no-go: two-face differences, gross pointings, bumps, drift, level and scatter; status 1 for no-go.

    One set-up is enough. What was measured on both faces or again later is compared with itself, the instrument's
    errors fitted. Writes check.json, two_face.csv and the picture check.svg to --out.

    Example: ltsim check my-recording --mpe 20,6 --out my-check
    """
    from ltsim.fieldcheck import check_file, write_check
    from ltsim.fieldcheck.items import TWO_FACE, CheckFile

    terminal.claim(CheckFile, TWO_FACE.file, "check.svg")
    limit = mpe_of(mpe)

    def look() -> Check:
        return lt.check(reading.of(source, growing=True), mpe=limit, **options)

    if watch:
        follow(terminal, look, changes(source))
        return 0
    recording = reading.open(source, terminal)
    with terminal.busy("checking"):
        found = lt.check(recording, mpe=limit, **options)
    content = check_file(found)
    if terminal.out is not None:
        from ltsim.pages.style import svg  # most checks draw nothing

        content = write_check(found, terminal.out, {"check.svg": svg(found.plot())})
    terminal.result(content)
    return 0 if found.passed else 1


def mpe_of(text: str | None) -> tuple[float, float] | None:
    """The limit that `A,B` states, um and um/m; raises RecordError when it is no two numbers above or equal to 0."""
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 2 or not all(is_number(part) and float(part) >= 0 for part in parts) or not float(parts[0]) > 0:
        raise RecordError(f"--mpe {text}: expected A,B in um and um/m, for instance 20,6")
    return float(parts[0]), float(parts[1])


def changes(source: Path) -> Iterator[None]:
    """One step whenever the recording's files have changed, the first at once; without end."""
    last: tuple[tuple[str, int, int], ...] | None = None
    while True:
        now = _state(source)
        if now != last:
            last = now
            yield
        time.sleep(POLL)


def _state(source: Path) -> tuple[tuple[str, int, int], ...]:
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    found = []
    for file in files:
        try:
            known = file.stat()
        except OSError:
            continue  # replaced between listing and looking
        found.append((file.name, known.st_size, known.st_mtime_ns))
    return tuple(found)


def follow(terminal: Terminal, look: Callable[[], Check], steps: Iterator[None]) -> None:
    """Check at every step and say what is new: what no longer passes, and when all passes again.

    A file that cannot be read or checked yet is looked at again at the next step; each reason is said once until then.
    """
    known: set[tuple[str, str, tuple[str, ...]]] = set()
    reasons: set[str] = set()
    for _ in steps:
        try:
            found = look()
        except (RecordError, NetworkError) as problem:
            reason = re.sub(r"\d+", "", str(problem))  # one row further on it is the same reason
            if reason not in reasons:
                terminal.note(f"waiting: {problem}")
            reasons.add(reason)
            continue
        reasons.clear()
        failed = [item for item in found.items if not item.passed]
        for item in failed:
            if _key(item) not in known:
                terminal.at_once(f"{len(found.recording)} pointings: NO-GO {item.sentence}", bell=True)
        if (known and not failed) or not known.union(map(_key, failed)):
            terminal.at_once(f"{len(found.recording)} pointings: {found.sentence}")
        known = set(map(_key, failed))


def _key(item: Item) -> tuple[str, str, tuple[str, ...]]:
    return item.station, item.kind, item.targets


def accept(file: AcceptFile, *, terminal: ResultTerminal) -> int:
    """Predict acceptance tests of a tracker, or judge errors that were found, against its maker's limits.

    Writes accept.json and accept.csv to --out. Exit status 1 when an error that was found is over its limit.

    Example: ltsim accept my-tracker.toml --out acceptance
    """
    from ltsim.acceptance.files import TESTS, AcceptanceFile

    terminal.claim(AcceptanceFile, TESTS.file)
    with terminal.busy("looking at the tests"):
        content = lt.accept(file)
    content = terminal.kept(content, lambda: {TESTS.file: content.table("tests").csv()})
    terminal.result(content)
    return int(content.kind != "predicted" and content.passes < 1)


def bench(file: BenchTable, *, terminal: ResultTerminal, **options: Any) -> None:
    """Find a reflector's range error against incidence from its bench test, with uncertainty.

    The table turns the reflector; the probe's first harmonic is the eccentricity, which is taken off the lengths.
    Writes bench.json to --out.

    Example: ltsim bench my-reflector.csv --out my-reflector
    """
    from ltsim.evaluation.bench import BenchFile

    terminal.claim(BenchFile)
    content = terminal.kept(lt.bench(file, **options))
    terminal.answer(content.content())
    terminal.say(repr(content))
    terminal.say("\n" + content.table().text())
    terminal.written(terminal.out)
