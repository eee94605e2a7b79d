"""Options that several commands share, and declarations of options that are arguments of public functions."""

from __future__ import annotations

import inspect
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

from ltsim.cli.output_checks import OutputKind, check_outputs
from ltsim.cli.terminal import Terminal, is_output_closed
from ltsim.core.arguments import (
    MAPPING_ARGUMENT_SYNTAX,
    MAX_MAPPING_ARGUMENT_MAGNITUDE,
    argument_bounds_text,
    bounded_number_parser,
    check_argument_choice,
)
from ltsim.core.errors import FLAG_BY_ARGUMENT_NAME, InputError

if TYPE_CHECKING:
    from ltsim.recordings import Hints, Recording


def option_flag(argument_name: str) -> str:
    """Flag on the command line of an argument, such as `--noise-from-data`."""
    return FLAG_BY_ARGUMENT_NAME.get(argument_name, "--" + argument_name.replace("_", "-"))


def bounded_option(argument_name: str, help_text: str, *short_flags: str) -> Any:
    """Option of a command whose value is a number within the bounds that `ARGUMENT_BOUNDS` has for `argument_name`."""
    return typer.Option(
        option_flag(argument_name),
        *short_flags,
        parser=bounded_number_parser(argument_name),
        metavar=f"NUMBER: {argument_bounds_text(argument_name)}",
        help=help_text,
    )


def choice_option(argument_name: str, choices: Sequence[str], help_text: str) -> Any:
    """Option of a command whose value is one of `choices`."""

    def parse_choice(text: str) -> str:
        check_argument_choice(argument_name, text, choices)
        return text

    return typer.Option(
        option_flag(argument_name),
        parser=parse_choice,
        metavar=f"[{'|'.join(choices)}]",
        autocompletion=lambda: choices,
        help=help_text,
    )


def name_list_option(argument_name: str, help_text: str) -> Any:
    """Option of a command whose value is a comma-separated list of names."""
    return typer.Option(option_flag(argument_name), metavar="NAME,...", help=help_text)


def split_names(text: str) -> tuple[str, ...]:
    """Names from a comma-separated list, without repetitions."""
    return tuple(dict.fromkeys(n.strip() for n in text.split(",") if n.strip()))


RecordingArgument = Annotated[
    Path, typer.Argument(metavar="REC", help="A recording: a folder, or a file in a format that is recognised.")
]
_CALIBRATION_OPTION = typer.Option("--calibration", metavar="FILE", help="A calibration.json, or its folder.")
CalibrationFileOption = Annotated[Path, _CALIBRATION_OPTION]
OptionalCalibrationFileOption = Annotated[Path | None, _CALIBRATION_OPTION]
JobsOption = Annotated[int, bounded_option("jobs", "Number of processes; the result does not depend on it.", "-j")]
ShowTemplateOption = Annotated[bool, typer.Option("--show", help="Print a commented template, and stop.")]
FormatNameOption = Annotated[
    str | None, typer.Option("--format", metavar="NAME", help="Format of REC; default by its content.")
]
HintsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--hint",
        metavar="KEY=VALUE",
        help="Interpretation of an ambiguous file: angle=gon, vertical=zenith, azimuth=clockwise, length=m, date=dmy, "
        "points=FILE, setup=FILE, station=NAME.",
    ),
]
ColumnsOption = Annotated[
    str | None,
    typer.Option(
        "--columns",
        metavar="ROLE=HEADER[UNIT],...",
        help='Roles of the columns of a table, e.g. "target=Name,azimuth=Hz[gon],zenith=V[gon],distance=D[m]".',
    ),
]
FrameFileOption = Annotated[
    Path | None,
    typer.Option(
        "--frame",
        metavar="FILE",
        help="Axes of the results: coordinates of some targets (targets.csv or a list of points), a scenario (file, "
        "or the name of a built-in one), or a TOML file with three targets: "
        'origin = "T01", x_axis = "T02", xy_plane = "T03".',
    ),
]
ControlFileOption = Annotated[
    Path | None,
    typer.Option(
        "--control",
        metavar="FILE",
        help="Table of control points (weighted known coordinates) of targets, with the columns target, x_mm, y_mm, "
        "z_mm and sigma_mm (or sigma_x_mm, sigma_y_mm, sigma_z_mm); an empty coordinate is unknown. A point that the "
        "readings contradict is reported and not used.",
    ),
]


def hints_from_texts(
    key_value_texts: list[str] | None, columns: str | None = None, *, is_growing: bool = False
) -> Hints:
    """Hints for the interpretation of a file from `KEY=VALUE` texts; raises InputError for an invalid key or value."""
    from ltsim.recordings.hints import hints_from_argument

    hints = hints_from_argument(dict(text.partition("=")[::2] for text in key_value_texts or []))
    return replace(hints, columns=columns or hints.columns, is_growing=is_growing)


@dataclass(frozen=True)
class ReadingOptions:
    """Options of a command for reading a recording: format, hints, and roles of columns."""

    format_name: FormatNameOption = None
    hint: HintsOption = None
    columns: ColumnsOption = None

    def read(self, path: Path, *, is_growing: bool = False) -> Recording:
        """Recording at `path`; `is_growing` permits an incomplete last line. Raises RecordError."""
        from ltsim.recordings import read

        hints = hints_from_texts(self.hint, self.columns, is_growing=is_growing)
        return read(path, format=self.format_name, hints=hints)

    def read_and_report(self, path: Path, terminal: Terminal) -> Recording:
        """Recording at `path`, whose notes and size are printed; raises RecordError."""
        recording = self.read(path)
        terminal.print_notes(recording.notes)
        terminal.print_text(recording.headline)
        return recording


@dataclass(frozen=True)
class ReadingOptionsWithControl(ReadingOptions):
    """Options of a command for reading a recording and a file of control points (targets with known coordinates).

    Levelled heights of control points, in the file or in `setup.toml`, are reported in a note.
    """

    control: ControlFileOption = None

    def read(self, path: Path, *, is_growing: bool = False) -> Recording:
        """Recording at `path`, with the control points of the file `control` if it is given; raises RecordError."""
        recording = super().read(path, is_growing=is_growing)
        if self.control is None and not (recording.setup.curved and recording.setup.targets):
            return recording
        from ltsim.adjustment.axes import with_control_points, with_levelled_control_note

        if self.control is not None:
            recording = with_control_points(recording, self.control)
        return with_levelled_control_note(recording, self.control.name if self.control else "setup.toml")


@dataclass(frozen=True)
class ReadingOptionsWithFrame(ReadingOptionsWithControl):
    """Options of a command for reading a recording, with control points and the coordinate frame of the results."""

    frame: FrameFileOption = None

    def read(self, path: Path, *, is_growing: bool = False) -> Recording:
        """Recording at `path`, with its datum in the frame of the file `frame` if it is given; raises RecordError."""
        recording = super().read(path, is_growing=is_growing)
        return recording if self.frame is None else with_datum_in_frame(recording, self.frame)


def typer_command(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function for Typer with one parameter per option, in place of parameters that are dataclasses of options."""
    hints = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {key: group for key, group in hints.items() if is_dataclass(group)}
    declared = inspect.signature(function).parameters
    parameters: list[inspect.Parameter] = []
    for key, parameter in declared.items():
        if key in groups:
            types = get_type_hints(groups[key], include_extras=True)
            parameters += [_keyword_parameter(f.name, types[f.name], f.default) for f in fields(groups[key])]
        else:
            parameters.append(_keyword_parameter(key, hints[key], parameter.default))
    outputs = list(_output_option_checks(parameters))

    def run(**values: Any) -> Any:
        places = ((flag, values[name], output) for name, flag, output in outputs if values[name] is not None)
        check_outputs(places, force=values.get("force", False))
        if values.get("as_json") and is_output_closed():
            raise InputError("--json prints to standard output, which is closed; open it, or omit --json")
        for key, group in groups.items():
            values[key] = group(**{f.name: values.pop(f.name) for f in fields(group)})
        return function(**values)

    run.__doc__ = function.__doc__
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _output_option_checks(parameters: list[inspect.Parameter]) -> Iterator[tuple[str, str, OutputKind]]:
    """Name, flag (placeholder for an argument) and `OutputKind` of each parameter that is an output file or folder."""
    for option in parameters:
        places: list[Any] = [item for item in get_args(option.annotation)[1:] if isinstance(item, OutputKind)]
        if places:
            info: Any = get_args(option.annotation)[1]
            flags = [word for word in (info.default, *(info.param_decls or ())) if str(word).startswith("--")]
            yield option.name, flags[0] if flags else info.metavar, places[0]


def _keyword_parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    """Keyword-only parameter of a function signature."""
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


@dataclass(frozen=True)
class FunctionOptions:
    """Options of a command that are keyword arguments of a public function.

    The annotation of a field consists of the type of its value on the command line, the option, and, where the function
    takes another type, a function that converts the value.
    """

    def arguments(self) -> dict[str, Any]:
        """Arguments of the public function by name, without the options that were not given and have no default.

        Raises InputError for an invalid value.
        """
        argument_by_name = {}
        for name, annotation in get_type_hints(type(self), include_extras=True).items():
            _, _, *conversions = get_args(annotation)
            value = getattr(self, name)
            if value is not None:
                argument_by_name[name] = conversions[0](value) if conversions else value
        return argument_by_name


@dataclass(frozen=True)
class PairParser:
    """Parser for an option that the user repeats with `NAME=VALUE` texts; the result is a mapping of name to value."""

    argument_name: str
    parse_value: Callable[[str], Any]

    def __call__(self, texts: Sequence[str]) -> dict[str, Any]:
        """Parsed value by name; raises InputError for a text that is not valid."""
        return dict(self._parse_pair(text) for text in texts)

    def _parse_pair(self, text: str) -> tuple[str, Any]:
        """Name and parsed value from a text NAME=VALUE; raises InputError if it is not valid."""
        key, _, value = (part.strip() for part in text.partition("="))
        with suppress(ValueError):
            if key and value:
                return key, self.parse_value(value)
        expected = MAPPING_ARGUMENT_SYNTAX[self.argument_name]
        raise InputError(f"{option_flag(self.argument_name)} {text}: expected {expected}")


def parse_number(text: str) -> float:
    """Number from a text; raises ValueError if it is not finite or too large."""
    value = float(text)
    if not abs(value) <= MAX_MAPPING_ARGUMENT_MAGNITUDE:
        raise ValueError
    return value


def parse_toml_value(text: str) -> Any:
    """Value of a TOML text; the text itself if it is not valid TOML."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def with_datum_in_frame(recording: Recording, frame: Path) -> Recording:
    """Copy of `recording` whose adjustment has the coordinate frame that `frame` defines.

    `frame` is a list of points, a TOML file with three targets that define the axes, or a scenario (file or built-in
    name). Raises RecordError or InputError.
    """
    from ltsim.adjustment.axes import with_axes_from_points, with_axes_from_three_targets
    from ltsim.recordings.coordinates import read_points
    from ltsim.recordings.settings import read_toml
    from ltsim.simulation.builtin import builtin_names

    if frame.exists() and str(frame) not in builtin_names():
        if frame.suffix.lower() != ".toml":
            coordinates = read_points(frame, refuses_contradictions=False).coordinates_by_name
            return with_axes_from_points(recording, coordinates, str(frame))
        frame_table = read_toml(frame, "frame")
        if {*(keys := ("origin", "x_axis", "xy_plane"))} <= frame_table.keys():
            return with_axes_from_three_targets(recording, *(str(frame_table[key]) for key in keys))
    from ltsim.simulation.scenario import load_scenario
    from ltsim.simulation.workshop import planned_layout

    plan = planned_layout(load_scenario(str(frame)))
    return with_axes_from_points(recording, dict(zip(plan.target_names, plan.target_points, strict=True)), str(frame))
