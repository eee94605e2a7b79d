"""Report pages as one HTML file that works offline: results with verdict, next actions and evidence."""

import importlib.metadata
import platform
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from ltsim.campaigns import require_campaign_packages
from ltsim.core.errors import LtsimError, RecordError, as_printable
from ltsim.recordings import read
from ltsim.recordings.native import OBSERVATIONS_FILE, SETUP_FILE
from ltsim.recordings.result_file import read_json, recording_digest
from ltsim.recordings.settings import read_setup
from ltsim.recordings.setup import ReportHeader
from ltsim.reports.document_model import (
    CONTENT_SECURITY_POLICY,
    Document,
    HallView,
    Section,
    SectionContext,
)
from ltsim.reports.formatting import natural_sort_key, typographic_text
from ltsim.reports.sections import SECTION_FUNCTION_BY_RESULT_FILE, read_content, result_section
from ltsim.reports.sections.network import TRUTH_FILE_NAME, recording_section

HEADLINE_BY_KIND_AND_ASSESSMENT = {
    ("Recording", "good"): "The readings agree with each other.",
    ("Recording", "bad"): "The readings do not agree with the declared set-up.",
    ("Calibration", "good"): "The calibration can be used.",
    ("Calibration", "caution"): "The calibration can be used: its model corrects an error of the recording.",
    ("Calibration", "bad"): "The calibration should not be used yet.",
    ("Network adjustment", "good"): "The network is consistent.",
    ("Network adjustment", "caution"): "The network is consistent after the correction of an error.",
    ("Network adjustment", "bad"): "The network does not agree with the declared noise and references.",
    ("Network adjustment", "plain"): "The instrument's errors are still in the coordinates.",
    ("Diagnosis", "good"): "No error was found.",
    ("Diagnosis", "bad"): "The recording contains an error.",
    ("History", "good"): "No change of the instrument was detected.",
    ("History", "bad"): "The instrument has changed.",
    ("Acceptance", "good"): "All errors are within the limits.",
    ("Acceptance", "caution"): "No error demonstrably exceeds its limit, but some are undecided.",
    ("Acceptance", "bad"): "Some errors exceed the limits.",
    ("Prediction", "good"): "The tracker is likely to pass all tests.",
    ("Prediction", "bad"): "The tracker is likely to fail a test.",
    ("Comparison", "good"): "No motion of a point was detected.",
    ("Comparison", "bad"): "Points moved.",
}
"""Headline of a page by the kind of its first result and the assessment of that result."""


REPORT_PAGE_FILE_NAME = "report.html"
"""Name of the HTML page in a folder of results."""
CAMPAIGN_MANIFEST_FILE_NAME = "manifest.json"
"""Name of the file that identifies the folder of a campaign."""
FIRST_RESULT_FILE_NAMES = ("diagnosis.json", "calibration.json")
"""Names of the result files that come first on a page; the first result determines the headline of the page."""
UNREADABLE_SECTION_KIND = "Not readable"
"""Kind of a section that shows the error of a folder that cannot be read."""


@dataclass(frozen=True)
class PagePart:
    """Part of a page: a result for one section, with its folder, its file and its recording."""

    folder: Path
    """Folder of the result."""
    result_file: str
    """Name of the result file in the folder."""
    recording: Path | None
    """Path of the recording from which the result was computed; None if it is not available."""
    omits_residuals: bool = False
    """True if another section of the page shows the residuals of the same recording."""


RESULT_FILES_IN_PAGE_ORDER = (
    "diagnosis.json",
    "calibration.json",
    OBSERVATIONS_FILE,
    *(k for k in SECTION_FUNCTION_BY_RESULT_FILE if k not in FIRST_RESULT_FILE_NAMES),
    CAMPAIGN_MANIFEST_FILE_NAME,
)
"""Files that identify the content of a folder, in the order of the page; the first one determines the headline."""


def section_of_part(page_part: PagePart, hall_view: HallView = "none") -> Section:
    """Section of the page for one part; raises RecordError, and InputError if packages are missing."""
    if page_part.result_file == OBSERVATIONS_FILE:
        return recording_section(page_part.folder, hall_view=hall_view, omits_residuals=page_part.omits_residuals)
    if page_part.result_file == CAMPAIGN_MANIFEST_FILE_NAME:
        require_campaign_packages()
        from ltsim.reports.sections.campaign import campaign_section  # reads with packages that may be missing

        return campaign_section(page_part.folder)
    content = read_content(page_part.folder, page_part.result_file)
    recording = read(page_part.recording) if page_part.recording else None
    section = result_section(content, SectionContext(page_part.folder, recording, hall_view, page_part.omits_residuals))
    return replace(
        section, measurement_date=(content.recording and content.recording.measured_on) or section.measurement_date
    )


def document_of_folder(
    folder: Path, *, recording: Path | None = None, title: str | None = None, about: ReportHeader | None = None
) -> Document:
    """Document of the page that reports the results in a folder.

    `recording` is the recording of the results if it is elsewhere, `title` the title of the page if it is not the
    default, and `about` has texts for the head of the page by name.

    Raises
    ------
    RecordError
        When there is nothing to report, or a file directly in the folder is malformed.
    """
    if not folder.is_dir():
        raise RecordError("the folder does not exist; give a folder that a command wrote", file=folder)
    page_parts = _page_parts(folder, recording)
    sections = [replace(made, folder=part.folder.name) for part, made in _page_parts_with_sections(page_parts, folder)]
    sections.sort(key=lambda made: made.kind == UNREADABLE_SECTION_KIND)
    first_section = sections[0]
    return Document(
        title=title or first_section.title,
        summary=first_section.summary,
        assessment=first_section.assessment,
        sections=sections,
        package_versions=package_versions(),
        header_lines=_header_lines(page_parts, sections, about or ReportHeader()),
        headline=HEADLINE_BY_KIND_AND_ASSESSMENT.get((first_section.kind, first_section.assessment), ""),
        next_actions=_recommended_actions(sections),
        simulation_notice=first_section.simulation_notice,
    )


def _recommended_actions(sections: list[Section]) -> list[str]:
    """Next actions of the first section; if it has none, of the next one with actions and equal assessment."""
    first_section = sections[0]
    chosen = next((s for s in sections if s.next_actions and s.assessment == first_section.assessment), first_section)
    return first_section.most_urgent_actions or chosen.most_urgent_actions


def _header_lines(page_parts: list[PagePart], sections: list[Section], about: ReportHeader) -> list[tuple[str, str]]:
    """Header lines (name, text): instrument, date, operator, customer, axes; lines without a text are omitted.

    `about` are texts given by the user, by name of the line.
    """
    folders = dict.fromkeys(part.recording for part in page_parts if part.recording)
    setups = [
        read_setup(recording_folder / SETUP_FILE)
        for recording_folder in folders
        if (recording_folder / SETUP_FILE).is_file()
    ]
    reports = [setup.report for setup in setups if setup.report is not None]
    instruments = "; ".join(
        dict.fromkeys(filter(None, [*(s.instruments_text for s in setups), *(s.instrument_text for s in sections)]))
    )
    dates = ", ".join(dict.fromkeys(s.measurement_date[:10] for s in sections if s.measurement_date))
    fallback = {"instrument": instruments, "date": dates}
    lines = []
    for key in ReportHeader.model_fields:
        values = [getattr(about, key)] if getattr(about, key) else [getattr(entry, key) for entry in reports]
        text = ", ".join(dict.fromkeys(value for value in values if value)) or fallback.get(key)
        lines += [(key, text)] if text else []
    axes = "; ".join(dict.fromkeys(s.axes_text for s in sections if s.axes_text))
    return [*lines, *([("axes", axes)] if axes else [])]


def _page_parts(folder: Path, recording: Path | None) -> list[PagePart]:
    """Parts of the page of a folder: a part for each result in the folder, or in folders of it.

    `recording` is the recording that the user gave; None if the user gave none.
    """
    subfolders = sorted((p for p in folder.iterdir() if p.is_dir()), key=lambda p: natural_sort_key(p.name))
    page_parts = [
        PagePart(result_folder, kind, recording or _recording_folder(result_folder, folder))
        for kind in RESULT_FILES_IN_PAGE_ORDER
        for result_folder in (folder, *subfolders)
        if (result_folder / kind).is_file()
    ]
    if not page_parts:
        raise RecordError(
            f"the folder contains no results; expected one of {', '.join(RESULT_FILES_IN_PAGE_ORDER)}", file=folder
        )
    digests = [_recording_digest(part) for part in page_parts]
    recording_by_digest = {
        digest: part.recording for digest, part in zip(digests, page_parts, strict=True) if digest and part.recording
    }
    page_parts = [
        replace(part, recording=recording_by_digest.get(d, part.recording))
        for d, part in zip(digests, page_parts, strict=True)
    ]
    n_parts_by_recording = Counter(part.recording for part in page_parts)
    diagnosed = {part.recording for part in page_parts if part.result_file == "diagnosis.json"} - {None}
    return [
        replace(
            part,
            omits_residuals=n_parts_by_recording[part.recording] > 1
            if part.result_file == OBSERVATIONS_FILE
            else part.recording in diagnosed,
        )
        for part in page_parts
    ]


def _page_parts_with_sections(page_parts: list[PagePart], page_folder: Path) -> Iterator[tuple[PagePart, Section]]:
    """Parts of a page with their sections; the first recording is shown in 3D, others from above.

    All recordings are shown from above if `page_folder` holds a diagnosis and no `truth.json`, to keep the page small.
    A folder in `page_folder` that cannot be read becomes a section with the error, unless it is the only part.
    """
    shown_sources: set[Path | str | None] = set()
    only_from_above = (page_folder / "diagnosis.json").is_file() and not (page_folder / TRUTH_FILE_NAME).is_file()
    for part in page_parts:
        source = part.recording or _recording_digest(part)
        hall_view: HallView = (
            "none" if source in shown_sources and source else "floor-plan" if shown_sources or only_from_above else "3d"
        )
        try:
            section = section_of_part(part, hall_view)
        except LtsimError as problem:
            if part.folder == page_folder or len(page_parts) == 1:
                raise
            section = Section(part.folder.name, UNREADABLE_SECTION_KIND, str(problem), "bad")
        if {block.title for block in section.blocks} & {"Floor plan", "The hall in 3D"}:
            shown_sources.add(source)
        yield part, section


def _recording_digest(page_part: PagePart) -> str:
    """Digest of the recording from which the result of a page part was computed; empty if the result contains none."""
    if page_part.result_file == CAMPAIGN_MANIFEST_FILE_NAME:  # has no recording, and up to 32 MiB
        return ""
    try:
        if page_part.result_file == OBSERVATIONS_FILE:
            return recording_digest(read(page_part.folder))
        named = read_json(page_part.folder / page_part.result_file, "result")["recording"]["digest"]
    except (LtsimError, KeyError, TypeError, OSError):
        return ""
    return str(named)


def page_html(document: Document) -> str:
    """HTML of the page; all texts are escaped, and control characters in them are replaced."""
    loader = PackageLoader("ltsim.reports")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        finalize=lambda value: as_printable(value) if type(value) is str else value,
    )
    environment.filters["print"] = typographic_text
    environment.filters["cell"] = cell_markup
    files = "palette.css", "page.css", "page.js"
    palette, style, script = (loader.get_source(environment, file)[0] for file in files)
    assets = {"style": Markup(palette + style), "script": Markup(script)}
    return environment.get_template("page.html.j2").render(document=document, policy=CONTENT_SECURITY_POLICY, **assets)


def cell_markup(text: str) -> Markup:
    """Escaped text of a table cell: names may break after `_`, `:` and `.`, a number and its sigma do not break."""
    unbroken_text = as_printable(text).replace(" ± ", "\u00a0±\u00a0")
    return Markup(re.sub(r"[_:]|\.(?=[a-z])", r"\g<0><wbr>", str(escape(unbroken_text))))


def package_versions() -> list[tuple[str, str]]:
    """Name and version of each package that contributes to the page."""
    name_and_version = [("Python", platform.python_version())]
    for name in ("ltsim", "numpy", "scipy", "matplotlib", "pyvista"):
        try:
            name_and_version.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            name_and_version.append((name, "(not installed as a package)"))
    return name_and_version


def _recording_folder(result_folder: Path, page_folder: Path) -> Path | None:
    """Folder of the recording of the results in `result_folder`, or next to this folder; None if not found."""
    for candidate in (result_folder, result_folder / "recording", result_folder.parent / "recording", page_folder):
        if (candidate / OBSERVATIONS_FILE).is_file():
            return candidate.resolve()
    return None
