"""`ltsim evaluate`: the paper's criteria, before and after a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import ltsim as lt
from ltsim.cli.options import OptionalCalibrationFile, Out, Reading, Source
from ltsim.cli.places import Force, claim
from ltsim.cli.summary import calibration_of
from ltsim.cli.terminal import Terminal

if TYPE_CHECKING:
    from ltsim.evaluation import Criteria
    from ltsim.recording import Recording


def evaluate(
    source: Source,
    calibration: OptionalCalibrationFile = None,
    out: Out = None,
    *,
    reading: Reading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """How far the stations disagree about distances and coordinates, before and after a calibration.

    Writes criteria.json to --out. Without a calibration there is no "after".

    Example: ltsim evaluate my-recording --calibration my-calibration
    """
    from ltsim.calibration.result import gross_rows
    from ltsim.evaluation.criteria import CriteriaFile

    claim(out, CriteriaFile, force=force)
    recording = reading.open(source, terminal)
    gross = gross_rows(recording)
    if gross.any():
        rows = ", ".join(str(i + 1) for i in gross.nonzero()[0][:12])
        terminal.notes([f"{gross.sum()} pointings miss their target by far and are left out (rows {rows})"])
    found = None if calibration is None else calibration_of(terminal, calibration)
    show(terminal, lt.evaluate(recording, found), recording, out)


def show(terminal: Terminal, criteria: Criteria, recording: Recording, out: Path | None) -> None:
    """Write and print criteria."""
    from ltsim.evaluation.criteria import CriteriaFile
    from ltsim.recording.result_file import SourceEntry, write_result

    content = CriteriaFile.model_validate({"recording": SourceEntry.of(recording), **criteria.as_json()})
    if out is not None:
        write_result(out, content, {})
    terminal.answer(content.content())
    terminal.say(criteria.table().text())
    if out is not None:
        terminal.say(f"\nwritten to {out}")
