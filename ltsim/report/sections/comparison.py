"""What a report says of two epochs: which points moved, and which motion could not have been seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.recording.result_file import read_result
from ltsim.report import style
from ltsim.report.document import Fact, Section, Table, mood, picture
from ltsim.report.figures.displacements import displacements
from ltsim.report.words import p_text
from ltsim.uncertainty.comparison import ComparisonFile


def comparison_section(folder: Path) -> Section:
    """The section of a folder with `comparison.json`; raises RecordError."""
    content = read_result(folder, ComparisonFile)
    points = content.displacements
    rows = [
        [
            d.target,
            "moved" if d.moved else "",
            *(style.fixed(v, 1) for v in d.shift_um),
            *(style.fixed(v, 1) for v in d.semi_axes_um),
            p_text(d.p_value),
            style.fixed(d.visible_um[1], 0),
        ]
        for d in points
    ]
    header = ["target", "", "dx [µm]", "dy [µm]", "dz [µm]", "a [µm]", "b [µm]", "c [µm]", "p", "visible [µm]"]
    note = "a, b, c: semi-axes of the 95 % ellipsoid; visible: smallest motion found in 4 of 5 cases in any direction"
    figure = displacements(
        np.array([d.place_mm for d in points]),
        np.array([d.shift_um for d in points]),
        np.array([d.semi_axes_um for d in points]),
        np.array([d.moved for d in points]),
        [d.target for d in points],
    )
    caption = "Shift of each point from the first recording to the second, with the largest semi-axis as a circle."
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
