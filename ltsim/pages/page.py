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
from ltsim.pages.sections.acceptance import acceptance_section
from ltsim.pages.sections.calibration import calibration_section
from ltsim.pages.sections.check import check_section
from ltsim.pages.sections.comparison import comparison_section
from ltsim.pages.sections.diagnosis import diagnosis_section
from ltsim.pages.sections.further import next_section
from ltsim.pages.sections.hidden import beside_truth
from ltsim.pages.sections.history import history_section
from ltsim.pages.sections.plan import plan_section
from ltsim.pages.sections.recording import recording_section
from ltsim.pages.sections.uncertainty import uncertainty_section
from ltsim.pages.words import natural
from ltsim.recording import Recording, read
from ltsim.recording.files import write_text
from ltsim.recording.native import OBSERVATIONS, SETUP
from ltsim.recording.result_file import digest_of
from ltsim.recording.settings import read_setup
from ltsim.recording.setup import About

NAME = "report.html"
UNREADABLE = "Not readable"
WEIGHT = {"Diagnosis": 0, UNREADABLE: 2}
"""Whose answer stands first on a page of several parts: the diagnosis, else the first part's."""


def _campaign_section(folder: Path) -> Section:
    """The section of a campaign; what it is read with may be missing where nobody runs campaigns."""
    require_packages()
    from ltsim.pages.sections.campaign import campaign_section

    return campaign_section(folder)


Builder = Callable[["Part", Recording | None, Detail], Section]
KINDS: dict[str, Builder] = {
    OBSERVATIONS: lambda part, _, detail: recording_section(part.folder, detail=detail, brief=part.brief),
    "calibration.json": lambda part, recording, detail: calibration_section(
        part.folder, recording, detail=detail, brief=part.brief
    ),
    "diagnosis.json": lambda part, recording, _: beside_truth(diagnosis_section(part.folder, recording), part.folder),
    "history.json": lambda part, _, __: history_section(part.folder),
    "plan.json": lambda part, _, detail: plan_section(part.folder, detail=detail),
    "uncertainty.json": lambda part, _, __: uncertainty_section(part.folder),
    "check.json": lambda part, _, __: check_section(part.folder),
    "comparison.json": lambda part, _, __: comparison_section(part.folder),
    "accept.json": lambda part, _, __: acceptance_section(part.folder),
    "next.json": lambda part, _, __: next_section(part.folder),
    "manifest.json": lambda part, _, __: _campaign_section(part.folder),
}
"""What a folder holds, by the file that tells; in the order of the page."""


@dataclass(frozen=True)
class Part:
    """One section to come: its folder, kind, the recording behind it; `brief` where others tell more of that."""

    folder: Path
    kind: str
    recording: Path | None
    brief: bool = False


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
    first = min(sections, key=lambda section: WEIGHT.get(section.kind, 1))
    return Document(
        title=title or (first.title if len({part.recording for part in parts}) == 1 else folder.resolve().name),
        answer=first.answer,
        mood=first.mood,
        sections=sections,
        versions=versions(),
        about=_about(parts, about or About()),
        verdict=headline(first.kind, first.mood),
        actions=list(dict.fromkeys([*first.actions, *(a for s in sections for a in s.actions)]))[:MOST],
    )


def _about(parts: list[Part], given: About) -> list[tuple[str, str]]:
    """Who measured what for whom; several recordings may have several answers."""
    folders = dict.fromkeys(part.recording for part in parts if part.recording)
    files = [place / SETUP for place in folders if (place / SETUP).is_file()]
    setups = [read_setup(file) for file in files]
    stated = [setup.report for setup in setups if setup.report is not None]
    stated.append(
        About(instrument="; ".join(dict.fromkeys(s.instruments_in_words for s in setups)).strip("; ") or None)
    )
    said = []
    for key in About.model_fields:
        values = [getattr(given, key)] if getattr(given, key) else [getattr(entry, key) for entry in stated[:-1]]
        text = ", ".join(dict.fromkeys(value for value in values if value)) or getattr(stated[-1], key)
        said += [(key, text)] * bool(text)
    return said


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
    """The sections; each recording is shown in 3D once, the first of them to turn.

    A folder in the `top` one that cannot be read is a section that says so, unless there is nothing else.
    """
    shown: set[Path | str | None] = set()
    for part in parts:
        source = part.recording or _digest(part)
        detail: Detail = "none" if source in shown and source else "still" if shown else "turn"
        try:
            section = KINDS[part.kind](part, read(part.recording) if part.recording else None, detail)
            section = replace(section, actions=actions_of(part.kind, part.folder))
        except LtsimError as problem:
            if part.folder == top or len(parts) == 1:
                raise
            section = Section(part.folder.name, UNREADABLE, str(problem), "bad")
        if any(block.kind == "scene" for block in section.blocks):
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
    environment = Environment(
        loader=PackageLoader("ltsim.pages"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    source = environment.loader.get_source if environment.loader else None
    assert source is not None
    own = {name: Markup(source(environment, file)[0]) for name, file in (("style", "page.css"), ("script", "page.js"))}
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
