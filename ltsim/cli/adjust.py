"""`ltsim adjust`: targets and stations from a recording, taking the instrument as it is."""

from __future__ import annotations

import ltsim as lt
from ltsim.cli.calibrate import claim_results, finish
from ltsim.cli.options import FramedReading, Out, PointsFile, Source, Treatment
from ltsim.cli.places import Force
from ltsim.cli.terminal import Terminal


def adjust(
    source: Source,
    *,
    treatment: Treatment,
    out: Out = None,
    points: PointsFile = None,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Adjust the network of a recording without instrument parameters: targets, stations, outliers.

    Writes calibration.json, targets.csv and residuals.csv to --out.

    Example: ltsim adjust my-recording --robust --noise-from-data --out adjusted
    """
    claim_results(out, points, adjusted=True, force=force)
    recording = reading.open(source, terminal)
    with terminal.busy("adjusting"):
        found = lt.adjust(recording, **treatment.as_options())
    finish(terminal, found, out, points)
