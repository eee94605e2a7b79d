"""Blocks that several kinds share: residual figures, the floor plan, the 3D view, who stands where."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.arrays import Floats
from ltsim.calibration.files import read_targets
from ltsim.calibration.schema import Combination, DeterminedEntry
from ltsim.errors import ConvergenceError, NetworkError, installed, missing_extra
from ltsim.model.construction import stated_construction
from ltsim.pages import style
from ltsim.pages.document import Block, Detail, Note, Scene, Table, picture, table_of
from ltsim.pages.figures.floor_plan import floor_plan
from ltsim.pages.figures.residuals import USUAL, residuals_by_covariate, residuals_by_station
from ltsim.pages.residuals import Residuals
from ltsim.pages.words import natural
from ltsim.pages.workshop import Workshop
from ltsim.recording import Recording

TRUTH = "truth.json"
Pair = tuple[Adjustment, Adjustment]
"""The network without and with the instrument's parameters."""


def adjusted(recording: Recording) -> Pair:
    """The network without and with the instrument's parameters; raises NetworkError, ConvergenceError."""
    plain, full = adjust(recording), adjust(recording, stated_construction(recording))
    plain.solution.require_success()
    full.solution.require_success()
    return plain, full


def adjusted_if_possible(recording: Recording | None) -> Pair | None:
    """The same; None where there is no recording, or it cannot be adjusted."""
    try:
        return adjusted(recording) if recording is not None else None
    except (NetworkError, ConvergenceError):
        return None


def residual_blocks(after: Residuals, before: Residuals | None, *, what: str) -> list[Block]:
    """Residuals by station and against covariates; `what` names the difference between before and after."""
    compared = f" Grey: without {what}; blue: with." if before is not None else ""
    text = "Observed minus adjusted reading of every pointing; the bar is the root mean square."
    drawn = residuals_by_station(after, before)
    blocks: list[Block] = [picture("Residuals by station", drawn, text + compared)]
    if set(USUAL) & set(after.covariates):
        text = "Lines: running means with twice their standard error; where the model holds they stay at zero."
        drawn = residuals_by_covariate(after)
        blocks.append(picture("Residuals against what they might depend on", drawn, text))
    return blocks


def workshop_blocks(workshop: Workshop, *, detail: Detail) -> list[Block]:
    """The 3D view and the floor plan, as far as `detail` asks for them."""
    if detail == "none":
        return []
    text = (
        "Seen from above. No reflector may stand on the floor inside a shadow circle: the elevation limit of that "
        "station hides it. "
    )
    plan = picture("Floor plan", floor_plan(workshop), text + " ".join(workshop.notes))
    return [scene(workshop), plan] if detail == "turn" else [plan]


def scene(workshop: Workshop) -> Scene | Note:
    """The 3D view, with the page to turn; where it cannot be drawn, what it needs."""
    if not installed("pyvista"):
        return Note("No 3D view", str(missing_extra("3D views", "view")))
    from ltsim.pages.scene_page import picture_and_page  # pyvista takes a second to load, and only this needs it

    coloured = workshop.coloured("incidence")
    png, legend, page = picture_and_page(coloured)
    lines = "; ".join(line.rstrip(".") for line in legend.lines)
    by = f" Lines of sight are coloured by {coloured.sights.label}." if coloured.sights else ""
    caption = f"{lines[:1].upper()}{lines[1:]}.{by}"
    return Scene("The workshop in 3D", style.webp_uri(png), caption, page)


def undetermined(title: str, entries: Sequence[Combination], *, decimals: int, note: str = "") -> list[Table]:
    """Combinations of parameters that stay open, and the cure of each."""
    rows = [
        [
            " ".join(f"{'+' if c >= 0 else '−'} {abs(c):.2f} {name}" for name, c in entry.combination.items()),
            entry.cure or "–",
            "–" if entry.gain is None else f"{100 * entry.gain:.{decimals}f} %",
        ]
        for entry in entries
    ]
    header = ["combination, in units of the prior σ", "what would determine it", "told"]
    return [Table(title, header, rows, text_columns=2, note=note)] if rows else []


def combined(title: str, entries: Sequence[DeterminedEntry]) -> list[Table]:
    """Combinations of parameters that are known far better than each of them."""
    note = "Together they are known far better than each of them."
    return table_of(title, entries, "terms=combination", "instrument", "value", note=note)


def target_table(file: Path | None, *, note: str) -> list[Table]:
    """Coordinates of a `targets.csv` with their expanded uncertainty; none where there is no such file."""
    if file is None:
        return []
    names, points, sigma = read_targets(file)
    order = sorted(range(len(names)), key=lambda i: natural(names[i]))
    rows = [
        [names[i], *(style.fixed(1e3 * v, 4) for v in points[i]), *(style.number(2e6 * s, 2) for s in sigma[i])]
        for i in order
    ]
    header = ["target", "x [mm]", "y [mm]", "z [mm]", "U x [µm]", "U y [µm]", "U z [µm]"]
    return [Table("Targets", header, rows, note=f"U: expanded uncertainty, k = 2. {note}", folds=False)]


def targets_in_words(sigma: Floats) -> str:
    """How well targets are known, from their standard deviations (T, 3) [m]."""
    known = np.sqrt((sigma**2).sum(axis=1))
    known = np.sort(known[np.isfinite(known)])
    if not len(known):
        return ""
    typical, worst = (style.number(2e6 * s, 2) for s in (np.median(known), known[-1]))
    return f"A target is known to U = {typical} um (k = 2) in space, the worst to {worst} um."
