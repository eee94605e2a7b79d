"""Report page: one HTML file that works offline, with verdict, next actions and evidence."""

import importlib.metadata
import platform
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from ltsim.campaigns import require_packages
from ltsim.core.errors import LtsimError, RecordError
from ltsim.recordings import read
from ltsim.recordings.native import OBSERVATIONS_FILE, SETUP_FILE
from ltsim.recordings.result_file import read_json, recording_digest
from ltsim.recordings.settings import read_setup
from ltsim.recordings.setup import About
from ltsim.reports.document import CONTENT_SECURITY_POLICY, Detail, Document, ReportContext, Section
from ltsim.reports.sections import WRITERS, content_of, section_of
from ltsim.reports.sections.network import TRUTH, recording_section
from ltsim.reports.words import natural, typeset

MAX_ACTIONS = 3
"""Largest number of next actions at the head of a page."""


HEADLINES = {
    ("Recording", "good"): "The readings agree with each other.",
    ("Recording", "bad"): "The readings do not agree with the declared set-up.",
    ("Calibration", "good"): "The calibration can be used.",
    ("Calibration", "bad"): "The calibration should not be used yet.",
    ("Network", "good"): "The network is consistent.",
    ("Network", "bad"): "The network does not agree with the declared noise and references.",
    ("Network", "plain"): "The instrument's errors are still in the coordinates.",
    ("Diagnosis", "good"): "No error was found.",
    ("Diagnosis", "bad"): "The recording contains an error.",
    ("History", "good"): "The instrument has not changed.",
    ("History", "bad"): "The instrument has changed.",
    ("Acceptance", "good"): "All errors are within the limits.",
    ("Acceptance", "bad"): "Some errors exceed the limits.",
    ("Prediction", "good"): "The tracker is likely to pass all tests.",
    ("Prediction", "bad"): "The tracker is likely to fail a test.",
    ("Comparison", "good"): "No point moved.",
    ("Comparison", "bad"): "Points moved.",
}
"""Headline of a page by kind of result and verdict."""


NAME = "report.html"
MANIFEST = "manifest.json"
HEADS = ("diagnosis.json", "calibration.json")
UNREADABLE = "Not readable"


@dataclass(frozen=True)
class PagePart:
    """Folder, kind and recording of a section; a `brief` section leaves details of the recording to another one."""

    folder: Path
    kind: str
    recording: Path | None
    brief: bool = False


KINDS = ("diagnosis.json", "calibration.json", OBSERVATIONS_FILE, *(k for k in WRITERS if k not in HEADS), MANIFEST)
"""Files that identify the content of a folder, in the order of the page; the first one determines the headline."""


def section(part: PagePart, detail: Detail = "none") -> Section:
    """Section of the page for one folder; raises RecordError, and SetupError if packages are missing."""
    if part.kind == OBSERVATIONS_FILE:
        return recording_section(part.folder, detail=detail, brief=part.brief)
    if part.kind == MANIFEST:
        require_packages()
        from ltsim.reports.sections.campaign import campaign_section  # reads with packages that may be missing

        return campaign_section(part.folder)
    content = content_of(part.folder, part.kind)
    recording = read(part.recording) if part.recording else None
    made = section_of(content, ReportContext(part.folder, recording, detail, part.brief))
    return replace(made, measured=(content.recording and content.recording.measured) or made.measured)


def document(
    folder: Path, *, recording: Path | None = None, title: str | None = None, about: About | None = None
) -> Document:
    """Document of the page of a folder.

    Raises
    ------
    RecordError
        When there is nothing to report, or a file directly in the folder is malformed.
    """
    if not folder.is_dir():
        raise RecordError("this folder does not exist; give a folder that a command wrote", file=folder)
    parts = _parts(folder, recording)
    sections = [replace(made, folder=part.folder.name) for part, made in _sections(parts, folder)]
    sections.sort(key=lambda made: made.kind == UNREADABLE)
    first = sections[0]
    return Document(
        title=title or first.title,
        answer=first.answer,
        mood=first.mood,
        sections=sections,
        versions=versions(),
        about=_about(parts, sections, about or About()),
        verdict=HEADLINES.get((first.kind.split(" ", maxsplit=1)[0], first.mood), ""),
        actions=_actions(sections),
        notice=first.notice,
    )


def _actions(sections: list[Section]) -> list[str]:
    """Next actions of the section that heads the page, else of the first one with the same verdict."""
    first = sections[0]
    chosen = next((s for s in sections if s.actions and s.mood == first.mood), first)
    return list(dict.fromkeys(first.actions or chosen.actions))[:MAX_ACTIONS]


def _about(parts: list[PagePart], sections: list[Section], given: About) -> list[tuple[str, str]]:
    """Header lines (name, text): instrument, date, operator, customer, axes; unknown ones are omitted."""
    folders = dict.fromkeys(part.recording for part in parts if part.recording)
    setups = [read_setup(place / SETUP_FILE) for place in folders if (place / SETUP_FILE).is_file()]
    reports = [setup.report for setup in setups if setup.report is not None]
    instruments = "; ".join(
        dict.fromkeys(filter(None, [*(s.instruments_in_words for s in setups), *(s.instrument for s in sections)]))
    )
    days = ", ".join(dict.fromkeys(s.measured[:10] for s in sections if s.measured))
    fallback = {"instrument": instruments, "date": days}
    lines = []
    for key in About.model_fields:
        values = [getattr(given, key)] if getattr(given, key) else [getattr(entry, key) for entry in reports]
        text = ", ".join(dict.fromkeys(value for value in values if value)) or fallback.get(key)
        lines += [(key, text)] if text else []
    axes = ", ".join(dict.fromkeys(s.axes for s in sections if s.axes))
    return [*lines, *([("axes", axes)] if axes else [])]


def _parts(folder: Path, recording: Path | None) -> list[PagePart]:
    inner = sorted((p for p in folder.iterdir() if p.is_dir()), key=lambda p: natural(p.name))
    parts = [
        PagePart(place, kind, recording or _recording_of(place, folder))
        for kind in KINDS
        for place in (folder, *inner)
        if (place / kind).is_file()
    ]
    if not parts:
        raise RecordError(f"the folder contains no results; expected one of {', '.join(KINDS)}", file=folder)
    digests = [_digest(part) for part in parts]
    near = {digest: part.recording for digest, part in zip(digests, parts, strict=True) if digest and part.recording}
    parts = [replace(part, recording=near.get(d, part.recording)) for d, part in zip(digests, parts, strict=True)]
    used = Counter(part.recording for part in parts)
    diagnosed = {part.recording for part in parts if part.kind == "diagnosis.json"} - {None}
    return [
        replace(part, brief=used[part.recording] > 1 if part.kind == OBSERVATIONS_FILE else part.recording in diagnosed)
        for part in parts
    ]


def _sections(parts: list[PagePart], top: Path) -> Iterator[tuple[PagePart, Section]]:
    """Parts with their sections; the first recording is shown in 3D, others from above.

    The recording of a diagnosis alone is also shown from above, unless there is a truth, to keep its page small. A
    folder in `top` that cannot be read becomes a section with the error, unless it is the only one.
    """
    shown: set[Path | str | None] = set()
    flat = (top / "diagnosis.json").is_file() and not (top / TRUTH).is_file()
    for part in parts:
        source = part.recording or _digest(part)
        detail: Detail = "none" if source in shown and source else "plan" if shown or flat else "turn"
        try:
            made = section(part, detail)
        except LtsimError as problem:
            if part.folder == top or len(parts) == 1:
                raise
            made = Section(part.folder.name, UNREADABLE, str(problem), "bad")
        if {block.title for block in made.blocks} & {"Floor plan", "The workshop in 3D"}:
            shown.add(source)
        yield part, made


def _digest(part: PagePart) -> str:
    """Digest of the recording of a part; empty if a result names none."""
    try:
        if part.kind == OBSERVATIONS_FILE:
            return recording_digest(read(part.folder))
        named = read_json(part.folder / part.kind, "result")["recording"]["digest"]
    except (LtsimError, KeyError, TypeError, OSError):
        return ""
    return str(named)


def render(content: Document) -> str:
    """HTML of the page; all texts are escaped."""
    loader = PackageLoader("ltsim.reports")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters["print"] = typeset
    environment.filters["names"] = lambda text: Markup(re.sub(r"[_:]|\.(?=[a-z])", r"\g<0><wbr>", str(escape(text))))
    files = "palette.css", "page.css", "page.js"
    palette, style, script = (loader.get_source(environment, file)[0] for file in files)
    assets = {"style": Markup(palette + style), "script": Markup(script)}
    return environment.get_template("page.html.j2").render(document=content, policy=CONTENT_SECURITY_POLICY, **assets)


def versions() -> list[tuple[str, str]]:
    """Versions of the packages that made the page."""
    entries = [("Python", platform.python_version())]
    for name in ("ltsim", "numpy", "scipy", "matplotlib", "pyvista"):
        try:
            entries.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            entries.append((name, "(not installed as a package)"))
    return entries


def _recording_of(place: Path, top: Path) -> Path | None:
    """Folder of the recording of the results in a folder, searched in and next to it."""
    for candidate in (place, place / "recording", place.parent / "recording", top):
        if (candidate / OBSERVATIONS_FILE).is_file():
            return candidate.resolve()
    return None
