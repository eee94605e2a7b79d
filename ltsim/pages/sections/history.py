"""What a report says of an instrument's history: whether it has changed, its parameters' course, the tests."""

from __future__ import annotations

from pathlib import Path

from ltsim.calibration.events import ENOUGH_STEPS
from ltsim.calibration.history_schema import ChangeEntry, CourseEntry, HistoryFile
from ltsim.chances import p_is, p_text
from ltsim.pages import style
from ltsim.pages.document import Block, Fact, Section, Table, mood, picture
from ltsim.pages.figures.history import history_figure, told_apart
from ltsim.pages.words import count, listing
from ltsim.recording.result_file import read_result

LEVEL = 0.01


def history_section(folder: Path) -> Section:
    """The section of a folder with `history.json`; raises RecordError."""
    content = _shortened(read_result(folder, HistoryFile))
    since = content.since_first
    changed = bool(content.events) if _knows_usual(content) else since.p_value < LEVEL
    facts = [
        Fact("calibrations", str(len(content.calibrations))),
        Fact("events", str(len(content.events)), mood(not content.events)),
        Fact("p of no change since the first", p_text(since.p_value)),
        Fact("construction", content.construction or "–"),
    ]
    known = [p for p in content.parameters if p.constant.dof]
    blocks = [*_course(content, known), *_events(content), _parameters(known), _changes(content), _fits(content)]
    return Section(folder.name, "History", _answer(content), mood(not changed), facts, blocks)


def _shortened(content: HistoryFile) -> HistoryFile:
    """The same with labels that fit a table: without the words that all of them begin with."""
    labels = [c.label for c in content.calibrations]
    short = dict(zip(labels, told_apart(labels), strict=True))

    def renamed(change: ChangeEntry) -> ChangeEntry:
        ends = {"from_": short.get(change.from_, change.from_), "to": short.get(change.to, change.to)}
        return change.model_copy(update=ends)

    return content.model_copy(
        update={
            "calibrations": tuple(c.model_copy(update={"label": short[c.label]}) for c in content.calibrations),
            "changes": tuple(renamed(c) for c in content.changes),
            "events": tuple(
                e.model_copy(update={"from_": short.get(e.from_, e.from_), "to": short.get(e.to, e.to)})
                for e in content.events
            ),
            "since_first": renamed(content.since_first),
        }
    )


def _answer(content: HistoryFile) -> str:
    """The first sentence."""
    since, size = content.since_first, count(len(content.calibrations), "calibration")
    span = f"Over {size} from {since.from_} to {since.to} the instrument"
    tested = f"(χ² {since.chi2:.0f} for {since.dof}, {p_is(since.p_value)})"
    if content.events:
        steps = list(dict.fromkeys(f"between {e.from_} and {e.to}" for e in content.events))
        names = listing(list(dict.fromkeys(e.name for e in content.events)))
        return f"{span} had an event (a service, a blow) {listing(steps)}, in {names}."
    if since.p_value >= LEVEL:
        between = [c for c in content.changes if c.p_value < LEVEL]
        back = f", though it did between {listing([f'{c.from_} and {c.to}' for c in between])}" if between else ""
        return f"{span} shows no change since the first {tested}{back}."
    if _knows_usual(content):
        return f"{span} moved no more than it does from one calibration to the next {tested}."
    which = f", above all in {listing(since.changed)}" if since.changed else ", in no single parameter for certain"
    return f"{span} has changed since the first{which} {tested}."


def _knows_usual(content: HistoryFile) -> bool:
    return len(content.calibrations) > ENOUGH_STEPS


def _events(content: HistoryFile) -> list[Block]:
    """Steps that stand out of the usual ones."""
    rows = [
        [
            e.from_, e.to, e.name, f"{style.with_sigma(e.difference, e.sigma)} {style.unit_text(e.unit)}",
            f"{style.number(e.usual, 2)} {style.unit_text(e.unit)}", p_text(e.p_value),
        ]
        for e in content.events
    ]  # fmt: skip
    header = ["from", "to", "parameter", "step", "its usual step", "p"]
    note = "Steps that stand out of how the instrument moves otherwise."
    return [Table("Events", header, rows, 3, note)] if rows else []


def _course(content: HistoryFile, known: list[CourseEntry]) -> list[Block]:
    """The figure."""
    if not known:
        return []
    labels = tuple(c.label for c in content.calibrations)
    text = "Estimates with 95 % intervals; the band is the mean ± the spread of the true values between calibrations."
    return [picture("Course of the parameters", history_figure(labels, known), text)]


def _parameters(known: list[CourseEntry]) -> Table:
    """Last value, mean, spread, test of constancy."""
    rows = [
        [
            p.name, style.unit_text(p.unit) or "–", style.with_sigma(p.values[-1], p.sigmas[-1]),
            style.fixed(p.mean, 2), style.fixed(p.spread, 2), p_text(p.constant.p_value),
        ]
        for p in known
    ]  # fmt: skip
    marked = frozenset(i for i, p in enumerate(known) if p.constant.p_value < LEVEL)
    header = ["parameter", "unit", "last ± σ", "mean", "spread", "p constant"]
    note = "'p constant' is the chance of such differences if the parameter never moved; marked where under 1 %."
    return Table("Parameters", header, rows, 2, note, marked)


def _changes(content: HistoryFile) -> Table:
    """From each calibration to the next, and from the first to the last."""
    every = [*content.changes, content.since_first] if len(content.changes) > 1 else [content.since_first]
    rows = [
        [
            c.from_, c.to, listing(c.changed) or ("no single one" if c.p_value < LEVEL else "no change seen"),
            f"{c.chi2:.1f} / {c.dof}", p_text(c.p_value),
        ]
        for c in every
    ]  # fmt: skip
    header = ["from", "to", "above all", "χ² / parameters", "p"]
    marked = frozenset(i for i, c in enumerate(every) if c.p_value < LEVEL)
    return Table("Has it changed?", header, rows, 3, "Marked where no change is under 1 %.", marked)


def _fits(content: HistoryFile) -> Table:
    """How well each calibration fitted: a bad one makes changes look certain."""
    rows = [
        [c.label, f"{c.fit.chi2:.1f}", str(c.fit.dof), "–" if c.fit.sigma0 is None else f"{c.fit.sigma0:.3f}"]
        for c in content.calibrations
    ]
    note = "Where sigma0 is far above 1 the sigmas of that calibration are too small, and changes look too certain."
    return Table("Fits of the calibrations", ["calibration", "χ²", "degrees of freedom", "sigma0"], rows, 1, note)
