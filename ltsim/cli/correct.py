"""`ltsim correct`: the same recording with the instrument's errors taken out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import ltsim as lt
from ltsim.cli.options import CalibrationFile, FramedReading, Source
from ltsim.cli.places import Force, claim_recording
from ltsim.cli.summary import calibration_of
from ltsim.cli.terminal import Terminal
from ltsim.units import ARCSECOND, MICROMETRE

Destination = Annotated[Path, typer.Option("--out", metavar="REC2", help="Folder of the corrected recording.")]


def correct(
    source: Source,
    calibration: CalibrationFile,
    out: Destination,
    *,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Write the recording that an ideal tracker would have made, by a calibration of the instrument.

    Readings stay in the axes of each set-up; with --frame whatever is computed from them later is in those of FILE.

    Example: ltsim correct my-recording --calibration my-calibration --out corrected
    """
    import numpy as np

    from ltsim.geometry.polar import wrap

    claim_recording(out, force=force)
    recording = reading.of(source)
    terminal.notes(recording.notes)
    found = calibration_of(terminal, calibration)
    if not found.names:
        terminal.notes(["this calibration holds no instrument parameters; nothing changes"])
    if found.effects:
        beside = ", ".join(effect.effect for effect in found.effects)
        terminal.notes([f"estimated beside the calibration and not taken out of the readings: {beside}"])
    corrected = lt.correct(recording, found, again=force)
    lt.write(corrected, out)
    change = corrected.readings - recording.readings
    change[:, 1:] = wrap(change[:, 1:])
    largest = np.nanmax(np.abs(change), axis=0, initial=0.0)
    terminal.answer(
        {
            "pointings": len(recording),
            "largest_change": {
                "distance_um": largest[0] / MICROMETRE,
                "azimuth_arcsec": largest[1] / ARCSECOND,
                "elevation_arcsec": largest[2] / ARCSECOND,
            },
        }
    )
    terminal.say(
        f"{len(recording)} pointings corrected by up to {largest[0] / MICROMETRE:.1f} um in distance, "
        f"{largest[1] / ARCSECOND:.2f} arcsec in azimuth, {largest[2] / ARCSECOND:.2f} arcsec in elevation"
    )
    terminal.say(f"written to {out}")
