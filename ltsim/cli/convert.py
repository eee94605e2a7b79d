"""Command `convert`: conversion of a recording from one file format to another."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

import ltsim as lt
from ltsim.cli.options import FunctionOptions, ReadingOptionsWithFrame, bounded_option
from ltsim.cli.output_checks import (
    COMPARED_FILE_OUTPUT,
    FILE_OR_FOLDER_OUTPUT,
    RECORDING_OUTPUT,
    ForceOption,
    write_outputs,
)
from ltsim.cli.terminal import Terminal
from ltsim.recordings import FORMATS
from ltsim.recordings.summary import recording_summary

WRITABLE_FORMATS_TEXT = ", ".join(f.name for f in FORMATS if f.write is not None)
"""Names of the formats that ltsim writes, separated by commas."""

InputArgument = Annotated[Path, typer.Argument(metavar="IN", help="A recording in any format that ltsim reads.")]
OutputArgument = Annotated[Path, typer.Argument(metavar="OUT", help="File or folder to write."), FILE_OR_FOLDER_OUTPUT]
OutputFormatOption = Annotated[
    str, typer.Option("--to", metavar="NAME", help=f"Format to write: {WRITABLE_FORMATS_TEXT}.")
]


@dataclass(frozen=True)
class ConvertOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.convert`."""

    every: Annotated[
        int,
        bounded_option(
            "every",
            "Number N: only every N-th pointing from a station to a target in one face is written. Long monitoring "
            "recordings contain more pointings than a network needs.",
        ),
    ] = 1


def convert(
    source: InputArgument,
    destination: OutputArgument,
    to: OutputFormatOption = "native",
    *,
    options: ConvertOptions,
    reading_options: ReadingOptionsWithFrame,
    force: ForceOption = False,
    terminal: Terminal,
) -> None:
    """Read a recording in one format and write it in another.

    CSV tables with any column names are read: meaning and unit of each column come from the header or from --columns.
    Ambiguous conventions are decided from the data and reported; if the data are not sufficient, an error message asks
    for --hint. A setup.toml in the same folder gives noise, gauge and approximate positions. The output ends with a
    summary: set-ups, rounds, faces, readings, heights, time span, noise, reference values.

    Example: ltsim convert survey.csv my-recording --columns "target=Name,azimuth=Hz[gon]" --hint azimuth=clockwise
    """
    (RECORDING_OUTPUT if to == "native" else COMPARED_FILE_OUTPUT).check(destination, force)
    source_recording = reading_options.read(source)
    writer = partial(lt.convert, source_recording, to=to, **options.arguments())
    (recording,) = write_outputs({destination: writer}, force=force)
    terminal.print_notes(source_recording.notes)
    topics = recording_summary(recording)
    terminal.print_json({"pointings": len(recording), "notes": list(recording.notes), "summary": topics})
    terminal.print_text(recording.headline)
    width = max(map(len, topics))
    terminal.print_text("\n".join(f"  {topic:{width}}  {words}" for topic, words in topics.items()))
    notes_text = f"see the {len(recording.notes)} notes above" if recording.notes else "nothing"
    terminal.print_text(f"  {'assumptions':{width}}  {notes_text}")
    terminal.print_text(f"written to {destination} ({to})")
