"""Command `convert`: conversion between formats of recordings."""

from pathlib import Path
from typing import Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.options import FramedReading
from ltsim.cli.places import ANYWHERE, Force, check_file, check_recording
from ltsim.cli.terminal import Terminal
from ltsim.recordings import FORMATS
from ltsim.recordings.summary import recording_summary

WRITABLE = ", ".join(f.name for f in FORMATS if f.write is not None)

Input = Annotated[Path, typer.Argument(metavar="IN", help="A recording in any format that ltsim reads.")]
Output = Annotated[Path, typer.Argument(metavar="OUT", help="File or folder to write."), ANYWHERE]
To = Annotated[str, typer.Option("--to", metavar="NAME", help=f"Format to write: {WRITABLE}.")]


def convert(
    source: Input,
    destination: Output,
    to: To = "native",
    *,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
    **options: Annotated[Any, "convert every"],
) -> None:
    """Read a recording in one format and write it in another.

    Tables of any dialect are read: roles and units of the columns come from the header or from --columns. Ambiguous
    conventions are decided from the data and reported, or asked for: answer with --hint. A setup.toml in the same
    folder gives noise, gauge and places. The output ends with a summary: set-ups, rounds, faces, readings, heights,
    time span, noise, reference values.

    Example: ltsim convert survey.csv my-recording --columns "target=Name,azimuth=Hz[gon]" --hint azimuth=clockwise
    """
    (check_recording if to == "native" else check_file)(destination, force)
    recording = reading.of(source)
    terminal.notes(recording.notes)
    recording = lt.convert(recording, destination, to=to, **options)
    topics = recording_summary(recording)
    terminal.answer({"pointings": len(recording), "notes": list(recording.notes), "summary": topics})
    terminal.say(recording.headline)
    width = max(map(len, topics))
    terminal.say("\n".join(f"  {topic:{width}}  {words}" for topic, words in topics.items()))
    assumed = f"see the {len(recording.notes)} notes above" if recording.notes else "nothing"
    terminal.say(f"  {'assumed':{width}}  {assumed}")
    terminal.say(f"written to {destination} ({to})")
