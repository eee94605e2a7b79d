"""Arguments and options that several verbs share, single and in groups, and what is done with them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from ltsim.cli.terminal import Terminal
from ltsim.errors import RecordError
from ltsim.workers import MOST

if TYPE_CHECKING:
    from ltsim.recording import Hints, Recording

Source = Annotated[
    Path, typer.Argument(metavar="REC", help="A recording: a folder, or a file in a format that is recognised.")
]
Out = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder to write the results to.")]
_IN_FILE = typer.Option("--calibration", metavar="FILE", help="A calibration.json, or the folder that holds it.")
CalibrationFile = Annotated[Path, _IN_FILE]
OptionalCalibrationFile = Annotated[Path | None, _IN_FILE]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Root of all random draws; the same seed, the same result.")]
Jobs = Annotated[
    int, typer.Option("--jobs", "-j", min=1, max=MOST, help="Processes to work with; the result is the same.")
]
FormatName = Annotated[
    str | None, typer.Option("--format", metavar="NAME", help="Format of REC, where its content does not tell.")
]
HintList = Annotated[
    list[str] | None,
    typer.Option(
        "--hint",
        metavar="KEY=VALUE",
        help="What an ambiguous file means: angle=gon, vertical=zenith, azimuth=clockwise, length=m, date=dmy, "
        "points=FILE, setup=FILE, station=NAME.",
    ),
]
ColumnMap = Annotated[
    str | None,
    typer.Option(
        "--columns",
        metavar="ROLE=HEADER[UNIT],...",
        help='What the columns of a table hold, e.g. "target=Name,azimuth=Hz[gon],zenith=V[gon],distance=D[m]".',
    ),
]
FrameFile = Annotated[
    Path | None,
    typer.Option(
        "--frame",
        metavar="FILE",
        help="Axes of the results: coordinates of some targets (targets.csv or a list of points), a scenario (file, "
        "or the name of a built-in one), or a TOML file with three targets: "
        'origin = "T01", x_axis = "T02", xy_plane = "T03".',
    ),
]
ControlFile = Annotated[
    Path | None,
    typer.Option(
        "--control",
        metavar="FILE",
        help="Control points with weight: a table target, x_mm, y_mm, z_mm and sigma_mm (or sigma_x_mm, sigma_y_mm, "
        "sigma_z_mm); an empty coordinate is not known. One that the readings contradict is named and left out.",
    ),
]
Robust = Annotated[
    bool, typer.Option("--robust", help="Leave out readings that do not belong; each is tested again at the end.")
]
NoiseFromData = Annotated[
    bool,
    typer.Option("--noise-from-data", help="Estimate the noise of each observable and instrument from the readings."),
]
Datum = Annotated[
    str | None,
    typer.Option("--datum", metavar="T01,T02,...", help="Targets that define the datum, by inner constraints."),
]
PointsFile = Annotated[
    Path | None, typer.Option("--points", metavar="FILE", help="Write the adjusted points too: .csv, .ply or .glb.")
]


def names_of(listed: str | None) -> tuple[str, ...] | None:
    """Names from a list with commas; None for none."""
    return None if listed is None else tuple(dict.fromkeys(n.strip() for n in listed.split(",") if n.strip()))


def hints_of(pairs: list[str] | None, columns: str | None = None, *, growing: bool = False) -> Hints:
    """Hints from `KEY=VALUE` texts; raises RecordError when a key or a value is not known."""
    from ltsim.recording import Hints

    choices: dict[str, tuple[str, ...]] = {
        "angle": ("deg", "gon", "rad"),
        "vertical": ("zenith", "elevation"),
        "azimuth": ("clockwise", "counter-clockwise"),
        "length": ("mm", "m"),
        "date": ("dmy", "mdy"),
    }
    given: dict[str, Any] = {}
    keys = [f.name for f in fields(Hints) if f.name not in ("columns", "growing")]
    for pair in pairs or []:
        key, _, value = pair.partition("=")
        if key not in keys or not value:
            raise RecordError(f"--hint {pair}: expected KEY=VALUE with a key among {', '.join(keys)}")
        if key in choices and value not in choices[key]:
            raise RecordError(f"--hint {pair}: {key} can be {' or '.join(choices[key])}")
        given[key] = Path(value) if key in ("points", "setup") else value
    return Hints(**given, columns=columns, growing=growing)


@dataclass(frozen=True)
class Treatment:
    """How an adjustment treats its readings."""

    robust: Robust = False
    noise_from_data: NoiseFromData = False
    datum: Datum = None

    def as_options(self) -> dict[str, Any]:
        """The same as `ltsim.adjust` takes it."""
        return {"robust": self.robust, "noise_from_data": self.noise_from_data, "datum": names_of(self.datum)}


@dataclass(frozen=True)
class Reading:
    """How a recording is read whose content does not tell."""

    format_name: FormatName = None
    hint: HintList = None
    columns: ColumnMap = None

    def of(self, path: Path, *, growing: bool = False) -> Recording:
        """The recording, perhaps while it is being written; raises RecordError."""
        from ltsim.recording import read

        return read(path, format=self.format_name, hints=hints_of(self.hint, self.columns, growing=growing))

    def open(self, path: Path, terminal: Terminal) -> Recording:
        """The recording, with what its reader decided and its size said; raises RecordError."""
        found = self.of(path)
        terminal.notes(found.notes)
        terminal.say(found.headline)
        return found


@dataclass(frozen=True)
class FramedReading(Reading):
    """The same, with the axes of the results."""

    frame: FrameFile = None
    control: ControlFile = None

    def of(self, path: Path, *, growing: bool = False) -> Recording:
        """The recording, in the axes of `frame` or with the points of `control` if given; raises RecordError."""
        found = super().of(path, growing=growing)
        if self.control is not None:
            from ltsim.adjustment.axes import with_control

            found = with_control(found, self.control)
        return found if self.frame is None else in_axes(found, self.frame)


def ungrouped(verb: Callable[..., Any]) -> Callable[..., Any]:
    """A verb as Typer wants it: for a parameter that is a dataclass of options, the options themselves."""
    hints = get_type_hints(verb, include_extras=True)
    groups: dict[str, Any] = {name: group for name, group in hints.items() if is_dataclass(group)}
    single: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(verb).parameters.items():
        if name in groups:
            kinds = get_type_hints(groups[name], include_extras=True)
            single += [
                inspect.Parameter(f.name, parameter.kind, default=f.default, annotation=kinds[f.name])
                for f in fields(groups[name])
            ]
        else:
            single.append(parameter.replace(annotation=hints[name]))

    def run(**given: Any) -> Any:
        for name, group in groups.items():
            given[name] = group(**{f.name: given.pop(f.name) for f in fields(group)})
        return verb(**given)

    run.__doc__ = verb.__doc__
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in single}
    run.__signature__ = inspect.Signature(single)  # type: ignore[attr-defined]
    return run


def in_axes(recording: Recording, frame: Path) -> Recording:
    """The recording with its datum in the axes of a file or a built-in scenario; raises RecordError or SetupError."""
    from ltsim.adjustment.axes import in_axes_of_points, in_axes_of_three
    from ltsim.recording.coordinates import read_points
    from ltsim.recording.settings import read_toml
    from ltsim.simulation.builtin import builtin_names

    if frame.exists() and str(frame) not in builtin_names():
        if frame.suffix.lower() != ".toml":
            return in_axes_of_points(recording, read_points(frame, strict=False).by_name, str(frame))
        named = read_toml(frame, "frame")
        if {"origin", "x_axis", "xy_plane"} <= named.keys():
            return in_axes_of_three(recording, *(str(named[key]) for key in ("origin", "x_axis", "xy_plane")))
    from ltsim.simulation.scenario import load_scenario
    from ltsim.simulation.workshop import planned

    layout = planned(load_scenario(str(frame)))
    return in_axes_of_points(recording, dict(zip(layout.targets, layout.points, strict=True)), str(frame))
