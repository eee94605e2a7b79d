"""Reading a recording in whatever format it comes, writing it in those that others read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from ltsim.errors import RecordError, unknown_name
from ltsim.recording import native
from ltsim.recording.conventions import NO_HINTS, Hints
from ltsim.recording.files import decoded
from ltsim.recording.formats import (
    cern_lgc,
    gama,
    gama_writer,
    gsi,
    openindy,
    point_list,
    polar_text,
    spatialanalyzer,
)
from ltsim.recording.recording import Recording
from ltsim.recording.settings import sentence
from ltsim.recording.setup import Setup
from ltsim.recording.tables import reader as tables

HEAD = 16_384


@dataclass(frozen=True)
class Format:
    """One format: who recognises it by its first characters, reads and perhaps writes it.

    `suffixes` decide only between formats that both recognise a file.
    """

    name: str
    about: str
    suffixes: tuple[str, ...]
    recognises: Callable[[Path, str], bool]
    read: Callable[[Path, Hints], Recording]
    write: Callable[[Recording, Path], None] | None = None


FORMATS: tuple[Format, ...] = (
    Format(
        "native",
        "folder with observations.csv and setup.toml",
        ("", ".csv"),
        native.recognises,
        lambda path, _: native.read_recording(path),
        native.write_recording,
    ),
    Format(
        "spatialanalyzer",
        "SpatialAnalyzer instrument report (CompositeReport)",
        (".csv", ".txt"),
        spatialanalyzer.recognises,
        spatialanalyzer.read,
    ),
    Format(
        "cern-lgc",
        "input file of CERN's LGC",
        (".lgc", ".lgc2"),
        cern_lgc.recognises,
        cern_lgc.read,
    ),
    Format(
        "gama-local",
        "input file of GNU Gama",
        (".gkf", ".xml"),
        gama.recognises,
        gama.read,
        gama_writer.write,
    ),
    Format(
        "openindy",
        "OpenIndy project",
        (".xml",),
        openindy.recognises,
        openindy.read,
    ),
    Format(
        "gsi",
        "Leica GSI-8 and GSI-16",
        (".gsi",),
        gsi.recognises,
        gsi.read,
    ),
    Format(
        "polar-text",
        "plain text: station, target, azimuth, zenith or elevation, distance",
        (".txt", ".dat", ".asc"),
        polar_text.recognises,
        polar_text.read,
        polar_text.write,
    ),
    Format(
        "point-list",
        "names and coordinates: no recording, said so",
        (".txt", ".xyz", ".csv"),
        point_list.recognises,
        point_list.refuse,
    ),
    Format(
        "table",
        "delimited text with a header, a folder with a file a station, or a workbook",
        (".csv", ".tsv", ".txt", ".xlsx"),
        tables.recognises,
        tables.read,
    ),
)


def read(
    path: Path | str,
    *,
    format: str | None = None,  # noqa: A002
    hints: Hints = NO_HINTS,
    formats: tuple[Format, ...] = FORMATS,
) -> Recording:
    """Read a recording; the format is chosen by content, then by suffix, unless named.

    Parameters
    ----------
    path : path
        A folder or a file.
    format : str, optional
        Name of a format in `formats`.
    hints : Hints
        What the caller knows about an ambiguous file.

    Returns
    -------
    Recording
        Its `notes` say what was decided about ambiguous conventions, skipped or left out.

    Raises
    ------
    RecordError
        One sentence: what is wrong and where, or which hint is wanted.
    """
    path = Path(path)
    chosen = recognised(path, formats) if format is None else _named(format, formats)
    try:
        return chosen.read(path, hints)
    except ValidationError as problem:
        raise RecordError(sentence(problem.errors()[0], Setup), file=path) from None


def recognised(path: Path, formats: tuple[Format, ...] = FORMATS) -> Format:
    """The format of a file or folder; raises RecordError when nothing is there, or no format fits."""
    if not path.exists():
        raise RecordError("there is no such file or folder", file=path)
    head = ""
    if path.is_file():
        try:
            with path.open("rb") as stream:
                head = decoded(stream.read(HEAD)).replace("\r\n", "\n")
        except OSError as problem:
            raise RecordError(f"cannot be read ({problem.strerror})", file=path) from None
    fitting = [f for f in formats if f.recognises(path, head)]
    if not fitting:
        known = "; ".join(f"{f.name} ({f.about})" for f in formats)
        raise RecordError(f"is in no format known here: {known}", file=path)
    return next((f for f in fitting if path.suffix.lower() in f.suffixes), fitting[0])


def write(
    recording: Recording,
    path: Path | str,
    format: str = "native",  # noqa: A002
    formats: tuple[Format, ...] = FORMATS,
) -> None:
    """Write a recording in one of the formats that can be written.

    Raises
    ------
    RecordError
        When the format cannot hold it or the place cannot be written; nothing half-written stays behind.
    """
    able = tuple(f for f in formats if f.write is not None)
    writer = _named(format, able).write
    if writer is not None:
        writer(recording, Path(path))


def _named(name: str, formats: tuple[Format, ...]) -> Format:
    by_name = {f.name: f for f in formats}
    if name not in by_name:
        raise RecordError(str(unknown_name("format", name, by_name)))
    return by_name[name]
