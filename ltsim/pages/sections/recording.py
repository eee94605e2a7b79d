"""What a report says of a recording: what was measured, and whether it agrees with itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.chances import p_text, two_sided
from ltsim.errors import ConvergenceError, NetworkError
from ltsim.model.construction import stated_construction
from ltsim.pages import figures
from ltsim.pages.document import Block, Detail, Fact, Listing, Note, Section, Table, picture
from ltsim.pages.residuals import Residuals
from ltsim.pages.sections.network import residual_blocks, workshop_blocks
from ltsim.pages.words import agreement, count, duration
from ltsim.pages.workshop import from_adjustment
from ltsim.recording import Recording, read
from ltsim.recording.setup import Limits
from ltsim.units import DEGREE


def recording_section(folder: Path, *, detail: Detail = "turn", brief: bool = False) -> Section:
    """The section of a recording; a `brief` one leaves residuals to the section of its calibration.

    Raises
    ------
    RecordError
        When the recording cannot be read.
    """
    recording = read(folder)
    title = recording.setup.title or folder.name
    facts = _facts(recording)
    settings = _settings(folder)
    try:
        plain, full = adjusted(recording)
    except (NetworkError, ConvergenceError) as problem:
        answer = f"{_contents(recording)} The network could not be adjusted: {problem}."
        return Section(title, "Recording", answer, "bad", facts, [_table(recording), *settings])
    agrees, words = agreement(full.chi2, full.dof, full.p_value)
    outliers = full.outliers()
    found = f" Outliers: {count(len(outliers), 'reading')}." if outliers else ""
    answer = f"{_contents(recording)} With the instrument's parameters adjusted, {words}.{found}"
    facts += [
        Fact("χ² per degree of freedom", f"{full.chi2 / max(full.dof, 1):.3f}", "good" if agrees else "bad"),
        Fact("p, two-sided", p_text(two_sided(full.p_value)), "good" if agrees else "bad"),
        Fact("outliers", str(len(outliers)), "bad" if outliers else "plain"),
    ]
    before, after = Residuals.from_adjustment(plain), Residuals.from_adjustment(full)
    blocks: list[Block] = workshop_blocks(from_adjustment(full, plain=plain), detail=detail)
    blocks.append(_sky(recording, full))
    blocks += [] if brief else residual_blocks(after, before, what="the instrument's parameters")
    blocks += [_table(recording), *settings]
    return Section(title, "Recording", answer, "good" if agrees and not outliers else "bad", facts, blocks)


def adjusted(recording: Recording) -> tuple[Adjustment, Adjustment]:
    """The network without and with the instrument's parameters.

    Raises
    ------
    NetworkError, ConvergenceError
        When it cannot be adjusted.
    """
    plain, full = adjust(recording), adjust(recording, stated_construction(recording))
    plain.solution.require_success()
    full.solution.require_success()
    return plain, full


def _contents(recording: Recording) -> str:
    """One sentence about the size of a recording."""
    faces = "two faces" if (recording.face == 2).any() else "one face"
    time = f" over {duration(float(np.ptp(recording.time)))}" if recording.has_clock and len(recording) else ""
    return (
        f"{count(len(recording), 'pointing')} from {count(len(recording.stations), 'station')} to "
        f"{count(len(recording.targets), 'target')} in {faces}{time}."
    )


def _facts(recording: Recording) -> list[Fact]:
    """Sizes at a glance."""
    return [
        Fact("stations", str(len(recording.stations))),
        Fact("targets", str(len(recording.targets))),
        Fact("pointings", str(len(recording))),
        Fact("known lengths", str(len(recording.gauge.distance))),
    ]


def _sky(recording: Recording, adjustment: Adjustment) -> Block:
    """Where the stations look."""
    instrument = next(iter(recording.setup.instruments.values()), recording.setup.instrument)
    limits = instrument.limits or Limits()
    figure = figures.sky(
        recording.stations,
        recording.station,
        adjustment.sightings.azimuth,
        adjustment.sightings.elevation,
        recording.face,
        limits=(limits.elevation_min_deg * DEGREE, limits.elevation_max_deg * DEGREE),
    )
    return picture(
        "Where each station looks", figure, "Azimuth and elevation of every pointing in the station's own frame."
    )


def _table(recording: Recording) -> Table:
    """One row a station."""
    rows = []
    for s, name in enumerate(recording.stations):
        here = recording.station == s
        measured = recording.measured[here]
        missing = int((~measured).sum())
        begin = recording.time[here].min()
        rows.append(
            [
                name,
                str(here.sum()),
                str(len(set(recording.target[here].tolist()))),
                str(len(set(recording.face[here].tolist()))),
                str(missing),
                duration(float(begin)) if recording.has_clock else "–",
            ]
        )
    header = ["station", "pointings", "targets", "faces", "missing readings", "starts at"]
    return Table("Work of each station", header, rows)


def _settings(folder: Path) -> list[Block]:
    """The set-up file as it stands."""
    file = folder / "setup.toml"
    if not file.is_file():
        return [Note("", "There is no set-up file: the default noise and priors were used.")]
    return [Listing("Set-up of the recording (setup.toml)", file.read_text(encoding="utf-8"))]
