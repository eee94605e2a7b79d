"""What a report says of two epochs: which points moved, and which motion could not have been seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.chances import p_text
from ltsim.pages import style
from ltsim.pages.document import Fact, Section, Table, mood, picture
from ltsim.pages.figures.displacements import displacements, enlargement
from ltsim.pages.words import natural
from ltsim.recording.result_file import read_result
from ltsim.tasks.comparison import ComparisonFile


def comparison_section(folder: Path) -> Section:
    """The section of a folder with `comparison.json`; raises RecordError."""
    content = read_result(folder, ComparisonFile)
    points = sorted(content.displacements, key=lambda d: (not d.moved, natural(d.target)))
    rows = [
        [
            d.target,
            "moved" if d.moved else "",
            *(style.fixed(v, 1) for v in d.shift_um),
            " / ".join(style.fixed(v, 0) for v in d.semi_axes_um),
            p_text(d.p_value),
            style.fixed(d.visible_um[1], 0),
        ]
        for d in points
    ]
    header = ["target", "", "dx [µm]", "dy [µm]", "dz [µm]", "ellipsoid [µm]", "p", "visible [µm]"]
    note = "ellipsoid: its semi-axes at 95 %; visible: smallest motion found in 4 of 5 cases in any direction"
    columns = ("place_mm", "shift_um", "semi_axes_um")
    places, shifts, axes = (np.array([getattr(d, column) for d in points]) for column in columns)
    figure = displacements(places, shifts, axes, np.array([d.moved for d in points]), [d.target for d in points])
    caption = (
        f"Shift of each point between the recordings, {enlargement(places, shifts, axes):.0f} times enlarged; "
        "the circle has the largest semi-axis of its 95 % ellipsoid."
    )
    return Section(
        title=folder.name,
        kind="Comparison",
        answer=content.sentence + ".",
        mood=mood(not any(d.moved for d in points)),
        facts=[
            Fact("points", str(len(points))),
            Fact("no motion at all", p_text(content.p_value), mood(content.p_value >= content.level)),
            Fact("without the moved ones", p_text(content.p_value_after)),
            *([] if content.scale_ppm is None else [Fact("scale", f"{content.scale_ppm:+.2f} ppm")]),
        ],
        blocks=[picture("Displacements", figure, caption), Table("Every point", header, rows, 2, note)],
    )
