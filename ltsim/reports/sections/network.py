"""Section of a recording, and blocks that several sections share: residuals, floor plan, 3D view, targets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.calibration.combinations import UNDETERMINED_TABLE, DeterminedEntry, UndeterminedEntry
from ltsim.calibration.files import read_targets
from ltsim.calibration.schema import STATION_COORDINATES_TABLE
from ltsim.core.arrays import Floats
from ltsim.core.errors import ConvergenceError, NetworkError, installed, missing_extra
from ltsim.core.notation import MISSING_TEXT, number_text
from ltsim.core.probability import p_text, two_sided
from ltsim.core.results import Table, numbers, texts
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings import Recording, read
from ltsim.reports import figures
from ltsim.reports.document import (
    Block,
    CodeBlock,
    Detail,
    Fact,
    Note,
    Picture,
    ReportContext,
    Scene,
    Section,
    TableBlock,
    mood,
    table_block,
    table_of,
)  # fmt: skip
from ltsim.reports.residuals import USUAL, Residuals
from ltsim.reports.words import agreement, count, duration, natural
from ltsim.simulation.truth import Truth, read_truth

if TYPE_CHECKING:
    from ltsim.reports.workshop import PlacedWorkshop

TRUTH = "truth.json"
WORK = Table(
    "work.csv",
    "work of each station",
    (
        *texts(station="name"),
        *numbers(pointings="number", targets="number", faces="number", missing_readings="number"),
        *texts(starts_at="time since the first pointing"),
    ),
)
Pair = tuple[Adjustment, Adjustment]
"""Adjusted networks without and with the instrument's parameters."""


def adjusted(recording: Recording) -> Pair:
    """Adjusted networks without and with the instrument's parameters; raises NetworkError, ConvergenceError."""
    plain, full = adjust(recording), adjust(recording, declared_construction(recording))
    plain.solution.require_success()
    full.solution.require_success()
    return plain, full


def adjusted_if_possible(recording: Recording | None) -> Pair | None:
    """Adjusted networks as of `adjusted`; None without a recording, or if it cannot be adjusted."""
    try:
        return adjusted(recording) if recording is not None else None
    except (NetworkError, ConvergenceError):
        return None


def truth_of(context: ReportContext) -> Truth | None:
    """Truth of a simulation in the folder of a result."""
    file = context.folder / TRUTH if context.folder else None
    return read_truth(file) if file is not None and file.is_file() else None


def residual_blocks(after: Residuals, before: Residuals | None) -> list[Block]:
    """Figures of residuals by station and over covariates; `before` is without the instrument's parameters."""
    compared = " Grey: without the instrument's parameters; blue: with." if before is not None else ""
    text = "Observed minus adjusted reading of every pointing; the bar is the root mean square."
    drawn = Picture(
        "Residuals by station", lambda: figures.residuals.residuals_by_station(after, before), text + compared
    )
    return [drawn, *over_covariates(after)]


def over_covariates(after: Residuals) -> list[Block]:
    """Figure of residuals over covariates."""
    text = "Lines: running means with twice their standard error; they stay at zero if the model is correct."
    title = "Residuals over covariates"
    shared = set(USUAL) & set(after.covariates)
    return [Picture(title, lambda: figures.residuals.residuals_by_covariate(after), text)] if shared else []


def workshop_blocks(shown: Callable[[], PlacedWorkshop], detail: Detail) -> list[Block]:
    """3D view and floor plan, according to `detail`."""
    if detail == "none":
        return []
    workshop = shown()
    text = (
        "Seen from above. Do not place a reflector on the floor inside a shadow circle: the elevation limit of the "
        "station hides it"
    )
    drawn = "; ".join([text, *workshop.notes]) + "."
    plan = Picture("Floor plan", lambda: figures.floor_plan.floor_plan(workshop), drawn)
    return [scene(workshop), plan] if detail == "turn" else [plan]


def scene(workshop: PlacedWorkshop) -> Scene | Note:
    """3D view with its interactive page; a note if packages are missing."""
    if not installed("pyvista"):
        return Note("No 3D view", str(missing_extra("3D views", "view")))
    from ltsim.reports.scene_page import picture_and_page  # slow to import
    from ltsim.reports.style import webp_uri

    coloured = workshop.coloured("incidence")
    picture, legend, page = picture_and_page(coloured)
    lines = "; ".join(line.rstrip(".") for line in legend.lines)
    by = f" Lines of sight are coloured by {coloured.sights.label}." if coloured.sights else ""
    caption = f"{lines[:1].upper()}{lines[1:]}.{by}"
    return Scene("The workshop in 3D", webp_uri(picture), caption, page)


def undetermined(title: str, entries: Sequence[UndeterminedEntry], *, note: str = "") -> list[TableBlock]:
    """Table of undetermined combinations of parameters, with the measurement that determines each."""
    rows = [[entry.text, entry.cure, None if entry.gain is None else 100 * entry.gain] for entry in entries]
    return table_block(title, UNDETERMINED_TABLE.filled(rows), note=note)


def combined(title: str, entries: Sequence[DeterminedEntry]) -> list[TableBlock]:
    """Table of combinations of parameters that are determined far better than the single ones."""
    note = "The combination is determined far better than its single parameters."
    return table_of(title, entries, "text=combination", "instrument", "value+-sigma", "unit", note=note)


def target_table(file: Path | None, *, note: str) -> list[TableBlock]:
    """Table of the coordinates in a `targets.csv` with expanded uncertainties; empty list without a file."""
    if file is None:
        return []
    names, points, sigma = read_targets(file)
    order = sorted(range(len(names)), key=lambda i: natural(names[i]))
    rows = [[names[i], *(1e3 * points[i]).tolist(), *(2e6 * sigma[i]).tolist()] for i in order]
    note = f"U: expanded uncertainty, k = 2. {note}"
    return table_block("Targets", STATION_COORDINATES_TABLE.filled(rows), note=note, folds=False)


def targets_in_words(sigma: Floats) -> str:
    """Sentence on the uncertainty of targets with sigmas (T, 3) [m]; in plan if heights are undetermined."""
    placed = sigma[np.isfinite(sigma[:, :2]).all(axis=1)]
    flat = bool(np.isnan(placed).any())
    sizes = np.sort(np.sqrt((placed[:, : 2 if flat else 3] ** 2).sum(axis=1)))
    if not len(sizes):
        return ""
    typical, worst = (number_text(2e6 * s, 2) for s in (np.median(sizes), sizes[-1]))
    where = "plan" if flat else "space"
    return f"Expanded uncertainty of a target in {where}: U = {typical} um (k = 2), {worst} um for the worst."


def recording_section(folder: Path, *, detail: Detail = "turn", brief: bool = False) -> Section:
    """Section of a recording; a `brief` one leaves residuals to the section of its calibration.

    Raises
    ------
    RecordError
        When the recording cannot be read.
    """
    from ltsim.reports.workshop import from_adjustment

    recording = read(folder)
    title = f"Recording: {recording.setup.title}" if recording.setup.title else "Recording of a tracker network"
    facts = [
        Fact("stations", str(len(recording.stations))),
        Fact("targets", str(len(recording.targets))),
        Fact("pointings", str(len(recording))),
        Fact("known lengths", str(len(recording.gauge.distance))),
    ]
    last: list[Block] = [*_table(recording), _settings(folder)]
    try:
        plain, full = adjusted(recording)
    except (NetworkError, ConvergenceError) as problem:
        answer = f"{_contents(recording)} The network could not be adjusted: {problem}."
        return Section(title, "Recording", answer, "bad", facts, last)
    agrees, words = agreement(full.chi2, full.dof, full.p_value)
    outliers = full.flagged_readings()
    outlier_text = f" Outliers: {count(len(outliers), 'reading')}." if outliers else ""
    facts += [
        Fact("sigma0", f"{np.sqrt(full.chi2 / max(full.dof, 1)):.3f}", mood(agrees)),
        Fact("p, two-sided", p_text(two_sided(full.p_value)), mood(agrees)),
        Fact("outliers", str(len(outliers)), "bad" if outliers else "plain"),
    ]
    workshop = from_adjustment(full, plain=plain) if detail != "none" else None
    if not brief:
        before, after = Residuals.from_adjustment(plain), Residuals.from_adjustment(full)
        last = [*residual_blocks(after, before), *last]
    del plain, full  # whose designs take more memory than all pictures
    blocks = workshop_blocks(lambda: workshop, detail) if workshop is not None else []
    answer = f"{_contents(recording)} With the instrument's parameters adjusted, {words}.{outlier_text}"
    return Section(title, "Recording", answer, mood(agrees and not outliers), facts, [*blocks, *last], shown=2)


def _contents(recording: Recording) -> str:
    faces = "two faces" if (recording.face == 2).any() else "one face"
    time = f" over {duration(float(np.ptp(recording.time)))}" if recording.has_clock and len(recording) else ""
    return (
        f"{count(len(recording), 'pointing')} from {count(len(recording.stations), 'station')} to "
        f"{count(len(recording.targets), 'target')} in {faces}{time}."
    )


def _table(recording: Recording) -> list[TableBlock]:
    rows = []
    for s, name in enumerate(recording.stations):
        here = recording.station == s
        sizes = (here.sum(), len(set(recording.target[here].tolist())), len(set(recording.face[here].tolist())))
        begin = duration(float(recording.time[here].min())) if recording.has_clock else MISSING_TEXT
        rows.append([name, *map(int, sizes), int((~recording.measured[here]).sum()), begin])
    return table_block("Work of each station", WORK.filled(rows))


def _settings(folder: Path) -> Block:
    file = folder / "setup.toml"
    if not file.is_file():
        return Note("Set-up", "There is no setup.toml; the default noise and priors were used.")
    return CodeBlock("Set-up of the recording (setup.toml)", file.read_text(encoding="utf-8"))
