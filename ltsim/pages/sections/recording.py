"""What a report says of a recording: what was measured, and whether it agrees with itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.chances import p_text, two_sided
from ltsim.errors import ConvergenceError, NetworkError
from ltsim.pages.document import Block, Detail, Fact, Listing, Note, Section, Table, mood
from ltsim.pages.residuals import Residuals
from ltsim.pages.sections.network import adjusted, residual_blocks, workshop_blocks
from ltsim.pages.words import agreement, count, duration
from ltsim.pages.workshop import from_adjustment
from ltsim.recording import Recording, read


def recording_section(folder: Path, *, detail: Detail = "turn", brief: bool = False) -> Section:
    """The section of a recording; a `brief` one leaves residuals to the section of its calibration.

    Raises
    ------
    RecordError
        When the recording cannot be read.
    """
    recording = read(folder)
    title = f"Recording: {recording.setup.title}" if recording.setup.title else "Recording of a tracker network"
    facts = [
        Fact("stations", str(len(recording.stations))),
        Fact("targets", str(len(recording.targets))),
        Fact("pointings", str(len(recording))),
        Fact("known lengths", str(len(recording.gauge.distance))),
    ]
    last: list[Block] = [_table(recording), _settings(folder)]
    try:
        plain, full = adjusted(recording)
    except (NetworkError, ConvergenceError) as problem:
        answer = f"{_contents(recording)} The network could not be adjusted: {problem}."
        return Section(title, "Recording", answer, "bad", facts, last)
    agrees, words = agreement(full.chi2, full.dof, full.p_value)
    outliers = full.outliers()
    found = f" Outliers: {count(len(outliers), 'reading')}." if outliers else ""
    facts += [
        Fact("sigma0", f"{np.sqrt(full.chi2 / max(full.dof, 1)):.3f}", mood(agrees)),
        Fact("p, two-sided", p_text(two_sided(full.p_value)), mood(agrees)),
        Fact("outliers", str(len(outliers)), "bad" if outliers else "plain"),
    ]
    blocks = workshop_blocks(from_adjustment(full, plain=plain), detail=detail)
    if not brief:
        before, after = Residuals.from_adjustment(plain), Residuals.from_adjustment(full)
        last = [*residual_blocks(after, before, what="the instrument's parameters"), *last]
    answer = f"{_contents(recording)} With the instrument's parameters adjusted, {words}.{found}"
    return Section(title, "Recording", answer, mood(agrees and not outliers), facts, [*blocks, *last], shown=2)


def _contents(recording: Recording) -> str:
    """One sentence about the size of a recording."""
    faces = "two faces" if (recording.face == 2).any() else "one face"
    time = f" over {duration(float(np.ptp(recording.time)))}" if recording.has_clock and len(recording) else ""
    return (
        f"{count(len(recording), 'pointing')} from {count(len(recording.stations), 'station')} to "
        f"{count(len(recording.targets), 'target')} in {faces}{time}."
    )


def _table(recording: Recording) -> Table:
    """One row a station."""
    rows = []
    for s, name in enumerate(recording.stations):
        here = recording.station == s
        sizes = (here.sum(), len(set(recording.target[here].tolist())), len(set(recording.face[here].tolist())))
        begin = duration(float(recording.time[here].min())) if recording.has_clock else "–"
        rows.append([name, *map(str, sizes), str((~recording.measured[here]).sum()), begin])
    header = ["station", "pointings", "targets", "faces", "missing readings", "starts at"]
    return Table("Work of each station", header, rows)


def _settings(folder: Path) -> Block:
    """The set-up file as it stands."""
    file = folder / "setup.toml"
    if not file.is_file():
        return Note("Set-up", "There is no set-up file: the default noise and priors were used.")
    return Listing("Set-up of the recording (setup.toml)", file.read_text(encoding="utf-8"))
