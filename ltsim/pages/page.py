"""The page a person reads: one HTML file that opens offline, the answer first."""

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

from ltsim.campaigns import require_packages
from ltsim.errors import LtsimError, RecordError
from ltsim.pages.actions import MOST, actions_of, headline
from ltsim.pages.document import POLICY, Detail, Document, Section
from ltsim.pages.sections.calibration import calibration_section
from ltsim.pages.sections.diagnosis import diagnosis_section
from ltsim.pages.sections.plain import PLAIN, plain_section
from ltsim.pages.sections.plan import plan_section
from ltsim.pages.sections.recording import recording_section
from ltsim.pages.words import natural, typeset
from ltsim.recording import Recording, read
from ltsim.recording.files import write_text
from ltsim.recording.native import OBSERVATIONS, SETUP
from ltsim.recording.result_file import digest_of
from ltsim.recording.settings import read_setup
from ltsim.recording.setup import About

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
    """What a folder and the folders in it hold, in the order of the page."""
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

    A folder in the `top` one that cannot be read is a section that says so, unless there is nothing else.
    """
    shown: set[Path | str | None] = set()
    for part in parts:
        source = part.recording or _digest(part)
        detail: Detail = "none" if source in shown and source else "plan" if shown else "turn"
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
