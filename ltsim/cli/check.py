"""`ltsim check`: go or no-go in the field, from what was measured twice."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ltsim.cli.options import Out, Reading, Source
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal
from ltsim.errors import NetworkError, RecordError
from ltsim.recording.files import is_number

if TYPE_CHECKING:
    from ltsim.fieldcheck import Check, Item

LEVEL = 0.01
Level = Annotated[
    float, typer.Option("--level", min=1e-6, max=0.5, help="Chance of one false alarm in the whole recording.")
]
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
POLL = 1.0
"""[s] between two looks at the files of a recording that grows."""


def check(
    source: Source,
    level: Level = LEVEL,
    mpe: MpeOption = None,
    watch: Watch = False,
    out: Out = None,
    *,
    reading: Reading,
    force: Force = False,
    terminal: Terminal,
) -> int:
    """Go or no-go: two-face differences, gross pointings, bumps, drift, level and scatter; status 1 for no-go.

    One set-up is enough. What was measured on both faces or again later is compared with itself, the instrument's
    errors fitted. Writes check.json, two_face.csv and the picture check.svg to --out.

    Example: ltsim check my-recording --mpe 20,6 --out my-check
    """
    import ltsim as lt
    from ltsim.fieldcheck import check_file, write_check
    from ltsim.fieldcheck.files import TWO_FACE, CheckFile

    claim(out, CheckFile, (TWO_FACE.file, "check.svg"), force=force)
    limit = mpe_of(mpe)

    def look() -> Check:
        return lt.check(reading.of(source, growing=True), level=level, mpe=limit)

    if watch:
        follow(terminal, look, changes(source))
        return 0
    recording = reading.open(source, terminal)
    with terminal.busy("checking"):
        found = lt.check(recording, level=level, mpe=limit)
    content = check_file(found)
    if out is not None:
        from ltsim.pages.style import svg  # most checks draw nothing

        content = write_check(found, out, {"check.svg": svg(found.plot())})
    terminal.answer(content.content())
    for item in found.items:
        terminal.say(f"  {'ok   ' if item.passed else 'NO-GO'} {item.sentence}")
    terminal.say(found.sentence)
    if out is not None:
        terminal.say(f"written to {out}; for a page with pictures: ltsim report {out}")
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
    """Names, sizes and times of the files."""
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
