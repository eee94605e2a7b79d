"""`ltsim calibrate`: instrument parameters from a recording."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import ltsim as lt
from ltsim.cli.options import FramedReading, Out, PointsFile, Source, Treatment, names_of
from ltsim.cli.places import Force, claim, claim_file
from ltsim.cli.summary import show_calibration
from ltsim.cli.terminal import Terminal
from ltsim.errors import SetupError

if TYPE_CHECKING:
    from ltsim.calibration import Calibration


class Method(StrEnum):
    """Which estimator."""

    NETWORK = "network"
    DISTANCE = "distance"
    DISTANCE_L1 = "distance-l1"
    EQUATION_9 = "equation-9"
    EQUATION_9_L1 = "equation-9-l1"


class ConstructionName(StrEnum):
    """Which model of the tracker."""

    MISALIGNMENT = "misalignment"
    DH = "dh"
    STEERING_MIRROR = "steering-mirror"


MethodOption = Annotated[
    Method,
    typer.Option(
        help="Rigorous network adjustment; the paper's distance objective over what the readings determine (least "
        "squares or l1), or its own minimum, which fits the rest to the noise (equation-9)."
    ),
]
ConstructionOption = Annotated[
    ConstructionName | None,
    typer.Option(
        help="Misalignments of a source in the head (16), of a steering mirror (21), or the paper's D-H chain (78); "
        "default: what the set-up states."
    ),
]
ParameterList = Annotated[
    str | None,
    typer.Option(
        "--parameters",
        metavar="NAME,...",
        help="Estimate these alone, hold the others at zero; a beginning stands for several (azimuth-eccentricity), "
        "NAME@INSTRUMENT for those of one instrument.",
    ),
]
WithoutList = Annotated[
    str | None, typer.Option("--without", metavar="NAME,...", help="Parameters not to estimate: they are held at zero.")
]
HoldList = Annotated[
    list[str] | None,
    typer.Option("--hold", metavar="NAME=VALUE", help="A parameter to hold at a value, in its unit; can be repeated."),
]
PriorFile = Annotated[
    str | None,
    typer.Option(
        "--prior",
        metavar="FILE|none",
        help="What was known before, in place of the set-up: a calibration, a history, or none at all.",
    ),
]
Harmonics = Annotated[
    int | None, typer.Option("--harmonics", metavar="N", help="Order of a D-H chain's joint errors, 0 to 4; default 2.")
]
Degree = Annotated[
    int | None, typer.Option("--degree", metavar="N", help="Degree of a D-H chain's range errors, 0 to 9; default 2.")
]
Box = Annotated[
    float | None,
    typer.Option("--box", metavar="N", help="With --method equation-9: no parameter beyond N prior sigmas."),
]
WithEffects = Annotated[
    list[str] | None,
    typer.Option(
        "--with",
        metavar="EFFECT[:WHERE,...]",
        help="An effect of the catalogue to estimate too, at stations or targets, with constants as law=visit; what is "
        "not said, the readings choose. Or a law as a diagnosis tells it, 'vertical index ~ time:S3'. Can be repeated.",
    ),
]


def calibrate(
    source: Source,
    method: MethodOption = Method.NETWORK,
    construction: ConstructionOption = None,
    *,
    treatment: Treatment,
    parameters: ParameterList = None,
    without: WithoutList = None,
    hold: HoldList = None,
    prior: PriorFile = None,
    harmonics: Harmonics = None,
    degree: Degree = None,
    box: Box = None,
    with_effects: WithEffects = None,
    out: Out = None,
    points: PointsFile = None,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Find the instrument's parameters from a recording, with uncertainty, and say what it cannot tell.

    Writes calibration.json, targets.csv and residuals.csv to --out.

    Example: ltsim calibrate my-recording --out my-calibration
    """
    options = treatment.as_options()
    options |= {"parameters": names_of(parameters), "without": names_of(without) or (), "hold": held_values(hold)}
    options |= {"prior": prior, "harmonics": harmonics, "degree": degree, "box": box}
    options["with_effects"] = with_effects or ()
    claim_results(out, points, adjusted=False, force=force)
    recording = reading.open(source, terminal)
    built = construction.value if construction else None
    with terminal.busy("calibrating"):
        found = lt.calibrate(recording, method=method.value, construction=built, **options)
    finish(terminal, found, out, points)


def held_values(pairs: list[str] | None) -> dict[str, float]:
    """Values by name from `NAME=VALUE` texts; raises SetupError."""
    held: dict[str, float] = {}
    for pair in pairs or []:
        name, _, text = pair.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not name.strip() or not math.isfinite(value):
            raise SetupError(f"--hold {pair}: expected NAME=VALUE with a number, e.g. beam-tilt=2.5")
        held[name.strip()] = value
    return held


def claim_results(out: Path | None, points: Path | None, *, adjusted: bool, force: bool) -> None:
    """Make sure that a calibration, or a network `adjusted` without parameters, replaces nothing else."""
    from ltsim.calibration.schema import RESIDUALS, TARGETS, CalibrationFile

    names = (TARGETS.file, RESIDUALS.file)
    claim(out, CalibrationFile, names, force=force, own=lambda found: (found.method == "adjustment") == adjusted)
    claim_file(points, force=force)


def finish(terminal: Terminal, calibration: Calibration, out: Path | None, points: Path | None = None) -> None:
    """Write, then show."""
    from ltsim.calibration.files import calibration_file, write_calibration

    if points is not None:
        from ltsim.pages.points import write_points  # most runs need no export

        write_points(calibration, points)
    content = calibration_file(calibration) if out is None else write_calibration(calibration, out)
    terminal.answer(content.content())
    show_calibration(terminal, calibration)
    terminal.notes(calibration.notes)
    terminal.written(out)
