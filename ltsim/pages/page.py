"""The page a person reads: one HTML file that opens offline, the answer first, what to do next."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ltsim.calibration.schema import CalibrationFile
from ltsim.campaigns import require_packages
from ltsim.chances import AGREES
from ltsim.diagnosis.schema import DiagnosisFile
from ltsim.errors import LtsimError, RecordError
from ltsim.pages.document import POLICY, Detail, Document, Section
from ltsim.pages.sections.calibration import calibration_section
from ltsim.pages.sections.diagnosis import diagnosis_section
from ltsim.pages.sections.network import TRUTH, recording_section
from ltsim.pages.sections.plain import PLAIN, plain_section
from ltsim.pages.sections.plan import plan_section
from ltsim.pages.words import count, listing, natural, typeset
from ltsim.planning.schema import NextFile
from ltsim.recording import Recording, read
from ltsim.recording.files import write_text
from ltsim.recording.native import OBSERVATIONS, SETUP
from ltsim.recording.result_file import digest_of, read_result
from ltsim.recording.settings import read_setup
from ltsim.recording.setup import About
from ltsim.tasks.comparison import Comparison

MOST = 5
"""Actions at the head of a page."""


def actions_of(kind: str, folder: Path) -> list[str]:
    """Sentences, the most urgent first, for a folder whose file `kind` is readable; empty where nothing follows."""
    return WRITERS[kind](folder) if kind in WRITERS else []


def headline(kind: str, mood: str) -> str:
    """The verdict in a few words; empty for a kind that gives none."""
    first = kind.split(" ", maxsplit=1)[0]
    return HEADLINES.get((first, mood), "")


HEADLINES = {
    ("Recording", "good"): "The recording agrees with itself.",
    ("Recording", "bad"): "The recording does not agree with itself.",
    ("Calibration", "good"): "The calibration can be used.",
    ("Calibration", "bad"): "The calibration should not be used yet.",
    ("Network", "good"): "The network agrees with itself.",
    ("Network", "bad"): "The network does not agree with itself.",
    ("Diagnosis", "good"): "Nothing was found wrong.",
    ("Diagnosis", "bad"): "Something is wrong with this recording.",
    ("History", "good"): "The instrument has not changed.",
    ("History", "bad"): "The instrument has changed.",
    ("Acceptance", "good"): "The limits are kept.",
    ("Acceptance", "bad"): "The limits are not kept.",
    ("Comparison", "good"): "No point moved.",
    ("Comparison", "bad"): "Points moved.",
}


def _calibration(folder: Path) -> list[str]:
    content = read_result(folder, CalibrationFile)
    said = []
    left = [o for o in content.outliers if not o.left_out]
    if left:
        which = listing([f"{o.station} to {o.target} ({o.observable}, row {o.row})" for o in left], 3)
        said.append(f"Measure again or leave out {count(len(left), 'reading')} that did not fit: {which}.")
    test = content.fit.p_value
    if test is not None and test < AGREES / 2 and not content.noise_estimated:
        said.append("Find out why readings and model disagree: ltsim diagnose names what is missing from the model.")
    cures = dict.fromkeys(entry.cure.partition(" (gain ")[0] for entry in content.undetermined if entry.cure)
    said += [f"To determine what is still open: {cure.rstrip('.')}." for cure in list(cures)[:3]]
    if content.parameters and not said:
        said.append("Apply the calibration to later readings: ltsim correct.")
    return said


def _diagnosis(folder: Path) -> list[str]:
    content = read_result(folder, DiagnosisFile)
    said = [_sentence(finding.separate_by) for finding in content.findings if finding.separate_by]
    for finding in content.findings:
        where = finding.where
        trackers = [f"instrument {name}" for name in where.instruments]
        place = listing([*trackers, *where.stations, *where.targets]) or "the whole recording"
        follows = f" with {listing(where.covariates)}" if where.covariates else ""
        unnamed = f"what changes the {finding.carrier or 'readings'}{follows}"
        cause = f"the cause of {finding.effect}" if finding.known else unnamed
        said.append(f"Look for {cause} ({place}); targets.csv holds coordinates that allow for it.")
    return said


def _next(folder: Path) -> list[str]:
    return [_sentence(proposal.do) for proposal in read_result(folder, NextFile).proposals[:2]]


def _comparison(folder: Path) -> list[str]:
    moved = [d.target for d in read_result(folder, Comparison).displacements if d.moved]
    said = f"Look at what moved, and measure it again before it is used as a reference: {listing(moved)}."
    return [said] if moved else []


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:].rstrip('.')}."


WRITERS: dict[str, Callable[[Path], list[str]]] = {
    "diagnosis.json": _diagnosis,
    "calibration.json": _calibration,
    "comparison.json": _comparison,
    "next.json": _next,
}


NAME = "report.html"
UNREADABLE = "Not readable"


@dataclass(frozen=True)
class Part:
    """One section to come: its folder, kind, the recording behind it; `brief` where others tell more of that."""

    folder: Path
    kind: str
    recording: Path | None
    brief: bool = False


Builder = Callable[[Part, Recording | None, Detail], Section]


def _campaign_section(part: Part, _: Recording | None, __: Detail) -> Section:
    """The section of a campaign; what it is read with may be missing where nobody runs campaigns."""
    require_packages()
    from ltsim.pages.sections.campaign import campaign_section

    return campaign_section(part.folder)


KINDS: dict[str, Builder] = {
    "diagnosis.json": lambda part, recording, detail: diagnosis_section(part.folder, recording, detail=detail),
    "calibration.json": lambda part, recording, detail: calibration_section(
        part.folder, recording, detail=detail, brief=part.brief
    ),
    OBSERVATIONS: lambda part, _, detail: recording_section(part.folder, detail=detail, brief=part.brief),
    "plan.json": lambda part, _, detail: plan_section(part.folder, detail=detail),
    **{name: lambda part, _, __: plain_section(part.folder, PLAIN[part.kind]) for name in PLAIN},
    "manifest.json": _campaign_section,
}
"""What a folder holds, by the file that tells; in the order of the page, the first one's answer heads it."""


def report(
    folder: Path,
    *,
    recording: Path | None = None,
    title: str | None = None,
    about: About | None = None,
    tell: Callable[[str], None] = lambda words: None,
) -> Path:
    """Write `report.html` into a folder that a command left, and give its path; arguments as of `ltsim.report`.

    Raises
    ------
    RecordError
        When there is nothing to report, or a file of the folder itself is malformed; nothing is written then.
    """
    target, content = folder / NAME, document(folder, recording=recording, title=title, about=about)
    for section in content.sections:
        if section.kind == UNREADABLE:
            tell(section.answer)
    write_text(target, render(content))
    return target


def document(
    folder: Path, *, recording: Path | None = None, title: str | None = None, about: About | None = None
) -> Document:
    """What the page will say.

    Raises
    ------
    RecordError
        When there is nothing to report, or a file of the folder itself is malformed.
    """
    if not folder.is_dir():
        raise RecordError("there is no such folder; give the folder that a command wrote", file=folder)
    parts = _parts(folder, recording)
    sections = [replace(section, folder=part.folder.name) for part, section in _sections(parts, folder)]
    sections.sort(key=lambda section: section.kind == UNREADABLE)
    first = sections[0]
    return Document(
        title=title or first.title,
        answer=first.answer,
        mood=first.mood,
        sections=sections,
        versions=versions(),
        about=_about(parts, sections, about or About()),
        verdict=headline(first.kind, first.mood),
        actions=list(dict.fromkeys([*first.actions, *(a for s in sections for a in s.actions)]))[:MOST],
    )


def _about(parts: list[Part], sections: list[Section], given: About) -> list[tuple[str, str]]:
    """Who measured what for whom, when, in which axes: as asked for, else as set-ups and results say."""
    folders = dict.fromkeys(part.recording for part in parts if part.recording)
    setups = [read_setup(place / SETUP) for place in folders if (place / SETUP).is_file()]
    stated = [setup.report for setup in setups if setup.report is not None]
    instruments = "; ".join(dict.fromkeys(filter(None, (s.instruments_in_words for s in setups))))
    days = ", ".join(dict.fromkeys(s.measured[:10] for s in sections if s.measured))
    fallback = {"instrument": instruments, "date": days}
    said = []
    for key in About.model_fields:
        values = [getattr(given, key)] if getattr(given, key) else [getattr(entry, key) for entry in stated]
        text = ", ".join(dict.fromkeys(value for value in values if value)) or fallback.get(key)
        said += [] if text is None else [(key, text or "not stated")]
    axes = ", ".join(dict.fromkeys(s.axes for s in sections if s.axes))
    return [*said, ("axes", axes or "not stated")]


def _parts(folder: Path, recording: Path | None) -> list[Part]:
    inner = sorted((p for p in folder.iterdir() if p.is_dir()), key=lambda p: natural(p.name))
    found = [
        Part(place, kind, recording or _recording_of(place, folder))
        for kind in KINDS
        for place in (folder, *inner)
        if (place / kind).is_file()
    ]
    if not found:
        raise RecordError(f"holds nothing to report; expected one of {', '.join(KINDS)} in it", file=folder)
    digests = [_digest(part) for part in found]
    near = {digest: part.recording for digest, part in zip(digests, found, strict=True) if digest and part.recording}
    found = [replace(part, recording=near.get(d, part.recording)) for d, part in zip(digests, found, strict=True)]
    used = Counter(part.recording for part in found)
    diagnosed = {part.recording for part in found if part.kind == "diagnosis.json"} - {None}
    return [
        replace(part, brief=used[part.recording] > 1 if part.kind == OBSERVATIONS else part.recording in diagnosed)
        for part in found
    ]


def _sections(parts: list[Part], top: Path) -> Iterator[tuple[Part, Section]]:
    """The sections; the first recording is shown in 3D, others from above.

    So is that of a diagnosis alone, whose page is to be quick and small, unless it stands beside a truth. A folder in
    the `top` one that cannot be read is a section that says so, unless there is nothing else.
    """
    shown: set[Path | str | None] = set()
    flat = (top / "diagnosis.json").is_file() and not (top / TRUTH).is_file()
    for part in parts:
        source = part.recording or _digest(part)
        detail: Detail = "none" if source in shown and source else "plan" if shown or flat else "turn"
        try:
            section = KINDS[part.kind](part, read(part.recording) if part.recording else None, detail)
            section = replace(section, actions=actions_of(part.kind, part.folder))
        except LtsimError as problem:
            if part.folder == top or len(parts) == 1:
                raise
            section = Section(part.folder.name, UNREADABLE, str(problem), "bad")
        if {block.title for block in section.blocks} & {"Floor plan", "The workshop in 3D"}:
            shown.add(source)
        yield part, section


def _digest(part: Part) -> str:
    """Digest of a recording, or of the one that a result names; empty where it names none."""
    try:
        if part.kind == OBSERVATIONS:
            return digest_of(read(part.folder))
        named = json.loads((part.folder / part.kind).read_text(encoding="utf-8"))["recording"]["digest"]
    except (LtsimError, ValueError, KeyError, TypeError, OSError):
        return ""
    return str(named)


def render(content: Document) -> str:
    """The page as text; every name in it is escaped."""
    loader = PackageLoader("ltsim.pages")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters["print"] = typeset
    files = (("style", "page.css"), ("script", "page.js"))
    own = {name: Markup(loader.get_source(environment, file)[0]) for name, file in files}
    return environment.get_template("page.html.j2").render(document=content, policy=POLICY, **own)


def versions() -> list[tuple[str, str]]:
    """Versions of what made the page."""
    found = [("Python", platform.python_version())]
    for name in ("ltsim", "numpy", "scipy", "matplotlib", "pyvista"):
        try:
            found.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            found.append((name, "(not installed as a package)"))
    return found


def _recording_of(place: Path, top: Path) -> Path | None:
    """The recording behind the results of a folder, if it lies near."""
    for candidate in (place, place / "recording", place.parent / "recording", top):
        if (candidate / OBSERVATIONS).is_file():
            return candidate.resolve()
    return None
