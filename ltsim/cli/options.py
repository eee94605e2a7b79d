"""Options that several commands share, and options that are generated from parameters of public functions."""

from __future__ import annotations

import ast
import inspect
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

import ltsim as lt
from ltsim.cli.output_checks import OutputKind, check_outputs
from ltsim.cli.terminal import Terminal, is_output_closed
from ltsim.core.arguments import (
    ARGUMENT_BOUNDS,
    MAPPING_ARGUMENT_SYNTAX,
    MAX_MAPPING_ARGUMENT_MAGNITUDE,
    argument_bounds_text,
    bounded_number_parser,
    check_argument_choice,
)
from ltsim.core.errors import FLAG_BY_ARGUMENT_NAME, InputError, RecordError

if TYPE_CHECKING:
    from ltsim.recordings import Hints, Recording

RecordingArgument = Annotated[
    Path, typer.Argument(metavar="REC", help="A recording: a folder, or a file in a format that is recognised.")
]
_CALIBRATION_OPTION = typer.Option("--calibration", metavar="FILE", help="A calibration.json, or its folder.")
CalibrationFileOption = Annotated[Path, _CALIBRATION_OPTION]
OptionalCalibrationFileOption = Annotated[Path | None, _CALIBRATION_OPTION]
JobsOption = Annotated[
    int,
    typer.Option(
        "--jobs",
        "-j",
        parser=bounded_number_parser("jobs"),
        metavar=f"NUMBER: {argument_bounds_text('jobs')}",
        help="Number of processes; the result does not depend on it.",
    ),
]
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
        help="Control points with weight: a table target, x_mm, y_mm, z_mm and sigma_mm (or sigma_x_mm, sigma_y_mm, "
        "sigma_z_mm); an empty coordinate is unknown. A point that the readings contradict is reported and not used.",
    ),
]


def split_names(text: str | None) -> tuple[str, ...] | None:
    """Names from a comma-separated list, without repetitions; None if `text` is None."""
    return None if text is None else tuple(dict.fromkeys(n.strip() for n in text.split(",") if n.strip()))


def hints_from_texts(
    key_value_texts: list[str] | None, columns: str | None = None, *, is_growing: bool = False
) -> Hints:
    """Hints for the interpretation of a file from `KEY=VALUE` texts; raises RecordError for an invalid key or value."""
    from ltsim.recordings import Hints

    value_by_key: dict[str, Any] = {}
    types = {name: kind for name, kind in get_type_hints(Hints).items() if name not in ("columns", "is_growing")}
    for pair in key_value_texts or []:
        key, _, value = pair.partition("=")
        if key not in types or not value:
            raise RecordError(f"--hint {pair}: expected KEY=VALUE with a key among {', '.join(types)}")
        choices = get_args(get_args(types[key])[0])  # of `Literal[...] | None`
        if choices and value not in choices:
            raise RecordError(f"--hint {pair}: {key} can be {' or '.join(choices)}")
        value_by_key[key] = Path(value) if key in ("points", "setup") else value
    return Hints(**value_by_key, columns=columns, is_growing=is_growing)


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
    """Options of a command for reading a recording, with a file of control points."""

    control: ControlFileOption = None

    def read(self, path: Path, *, is_growing: bool = False) -> Recording:
        """Recording at `path`, with the control points of the file `control` if it is given; raises RecordError."""
        recording = super().read(path, is_growing=is_growing)
        if self.control is None:
            return recording
        from ltsim.adjustment.axes import with_control_points

        return with_control_points(recording, self.control)


@dataclass(frozen=True)
class ReadingOptionsWithFrame(ReadingOptionsWithControl):
    """Options of a command for reading a recording, with control points and the coordinate frame of the results."""

    frame: FrameFileOption = None

    def read(self, path: Path, *, is_growing: bool = False) -> Recording:
        """Recording at `path`, with its datum in the frame of the file `frame` if it is given; raises RecordError."""
        recording = super().read(path, is_growing=is_growing)
        return recording if self.frame is None else with_datum_in_frame(recording, self.frame)


def typer_command(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Function for Typer with one parameter per option, in place of parameters that are dataclasses of options.

    `**options` becomes the keyword parameters of `lt.NAME`. Texts in its annotation name other public functions, each
    with the parameters to use (default all). Parameters that the command declares itself are not repeated.
    """
    hints = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {key: group for key, group in hints.items() if is_dataclass(group)}
    declared = inspect.signature(function).parameters
    parameters: list[inspect.Parameter] = []
    api_options: list[FunctionOption] = []
    for key, parameter in declared.items():
        if key in groups:
            types = get_type_hints(groups[key], include_extras=True)
            parameters += [_keyword_parameter(f.name, types[f.name], f.default) for f in fields(groups[key])]
        elif parameter.kind is parameter.VAR_KEYWORD:
            functions = [text.split() for text in get_args(hints[key])[1:]] or [[name]]
            api_options = [
                o for api_name, *names in functions for o in function_options(api_name, names) if o.name not in declared
            ]
        else:
            parameters.append(_keyword_parameter(key, hints[key], parameter.default))
    outputs = list(_output_option_checks(parameters))
    following = ("out", *ReadingOptions.__dataclass_fields__)  # the options of the function come before these
    index = next((i for i, p in enumerate(parameters) if p.name in following), len(parameters))
    parameters[index:index] = [option.typer_parameter for option in api_options]

    def run(**values: Any) -> Any:
        places = ((flag, values[name], output) for name, flag, output in outputs if values[name] is not None)
        check_outputs(places, force=values.get("force", False))
        if values.get("as_json") and is_output_closed():
            raise InputError("--json prints to standard output, which is closed; open it, or omit --json")
        for key, group in groups.items():
            values[key] = group(**{f.name: values.pop(f.name) for f in fields(group)})
        return function(**values | {option.name: option.argument_value(values[option.name]) for option in api_options})

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


PYTHON_ONLY_PARAMETERS = ("advise", "allow_repeated", "geometry", "about", "format", "hints", "callbacks")
"""Parameters of public functions that have no option on the command line."""
SHORT_FLAGS = {"trials": "-n", "jobs": "-j"}
"""Short flag of an option on the command line, by the name of the parameter of the public function."""
PLACEHOLDERS = {"prior": "FILE|none", "with_effects": "EFFECT[:WHERE,...]", "calibrator": "'CMD {recording} {out}'"}
"""Placeholder of an option's value in the help, by the name of the parameter of the public function."""


def _parse_number(text: str) -> float:
    """Number from a text; raises ValueError if it is not finite or too large."""
    value = float(text)
    if not abs(value) <= MAX_MAPPING_ARGUMENT_MAGNITUDE:
        raise ValueError
    return value


def _parse_toml_value(text: str) -> Any:
    """Value of a TOML text; the text itself if it is not valid TOML."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


MAPPING_OPTIONS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "hold": ("NAME=VALUE", _parse_number),
    "tolerance": ("NAME=QUANTITY", lambda text: text.strip("'\"")),
    "changes": ("KEY=VALUE", _parse_toml_value),
    "move": ("STATION=X,Y[,Z[,YAW]]", lambda text: text.split(",")),
}
"""Placeholder in the help, and parser of a value, of each option that collects NAME=VALUE pairs, by parameter name."""


@dataclass(frozen=True)
class FunctionOption:
    """Option made from a parameter of a public function: default from the signature, help from the docstring."""

    name: str
    annotation: str
    default: Any
    help: str
    docstring_type: str
    """Type of the parameter in the docstring, which may list the permitted values."""

    @property
    def choices(self) -> list[str]:
        """Permitted values, if the docstring lists them, as in {`mm`, `m`}; otherwise empty."""
        return re.findall(r"`([^`]+)`", self.docstring_type) if self.docstring_type.startswith("{") else []

    @property
    def flag(self) -> str:
        """Flag on the command line, such as `--noise-from-data`."""
        return FLAG_BY_ARGUMENT_NAME.get(self.name, "--" + self.name.replace("_", "-"))

    @property
    def is_repeatable(self) -> bool:
        """True if the option may be given several times."""
        return self.name in MAPPING_OPTIONS or "Effect" in self.annotation or self.annotation.startswith("Sequence")

    @property
    def is_name_list(self) -> bool:
        """True if the value of the option is a comma-separated list of names."""
        return not self.is_repeatable and "Sequence[str]" in self.annotation

    @property
    def typer_parameter(self) -> inspect.Parameter:
        """Parameter of the command's function, from which Typer makes the option."""
        flags = [self.flag, *([SHORT_FLAGS[self.name]] if self.name in SHORT_FLAGS else [])]
        kind: Any = float if "float" in self.annotation else int if "int" in self.annotation else str
        metavar = MAPPING_OPTIONS[self.name][0] if self.name in MAPPING_OPTIONS else PLACEHOLDERS.get(self.name)
        if self.annotation.startswith("bool"):
            kind = bool
            flags = flags if self.default is False else [f"{self.flag}/--no-{self.flag[2:]}"]
        elif self.choices:
            kind, metavar = str, f"[{'|'.join(self.choices)}]"
        elif self.is_name_list:
            metavar = "NAME,..."
        elif self.name in ARGUMENT_BOUNDS:
            metavar = f"NUMBER: {argument_bounds_text(self.name)}"
        elif metavar is None:
            metavar = "FILE" if "Path" in self.annotation else "NAME" if kind is str else "N"
        default = self.default
        if self.is_repeatable or default is None or default == ():
            kind, default = (list[str] if self.is_repeatable else kind) | None, None
        completion = (lambda: self.choices) if self.choices else None
        parser = bounded_number_parser(self.name) if self.name in ARGUMENT_BOUNDS else None
        option = typer.Option(*flags, help=self.help, metavar=metavar, autocompletion=completion, parser=parser)
        return _keyword_parameter(self.name, Annotated[kind, option], default)

    def argument_value(self, command_line_value: Any) -> Any:
        """Argument of the public function from the value on the command line; raises InputError if it is invalid."""
        if command_line_value is None or command_line_value == []:
            return self.default
        if self.choices:
            check_argument_choice(self.name, command_line_value, self.choices)
        if self.name in MAPPING_OPTIONS:
            return dict(self._parse_pair(text) for text in command_line_value)
        if self.is_name_list:
            return split_names(command_line_value)
        return tuple(command_line_value) if self.is_repeatable else command_line_value

    def _parse_pair(self, text: str) -> tuple[str, Any]:
        """Name and parsed value from a text NAME=VALUE; raises InputError if it is not valid."""
        _, parse = MAPPING_OPTIONS[self.name]
        key, _, value = (part.strip() for part in text.partition("="))
        with suppress(ValueError):
            if key and value:
                return key, parse(value)
        raise InputError(f"{self.flag} {text}: expected {MAPPING_ARGUMENT_SYNTAX[self.name]}")


def function_options(function_name: str, parameter_names: list[str]) -> list[FunctionOption]:
    """Options for keyword parameters of a public function, from its parsed source; all without `parameter_names`."""
    tree = _module_syntax_tree(lt._MODULE_BY_PUBLIC_NAME[function_name])
    node = next(n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function_name)
    meanings = dict(_documented_parameters(inspect.cleandoc(ast.get_docstring(node) or "")))
    options = []
    for argument, default in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True):
        name, annotation = argument.arg, ast.unparse(argument.annotation or ast.Constant("str"))
        value = _constant_value(tree, default.id) if isinstance(default, ast.Name) else default
        if (
            (parameter_names and name not in parameter_names)
            or name in PYTHON_ONLY_PARAMETERS
            or not isinstance(value, ast.Constant | ast.Tuple)
        ):
            continue
        docstring_type, text = meanings[name]
        if other := re.search(r"[Aa]s of `(\w+)`", text):
            referenced_options = {option.name: option for option in function_options(other[1], [name])}
            docstring_type, text = referenced_options[name].docstring_type, referenced_options[name].help
        options.append(FunctionOption(name, annotation, ast.literal_eval(value), text.replace("`", ""), docstring_type))
    return options


def _module_syntax_tree(module: str) -> ast.Module:
    """Syntax tree of a module of ltsim; `module` is its name without the package, such as `core.units`."""
    return ast.parse((Path(lt.__file__).parent / f"{module.replace('.', '/')}.py").read_text("utf-8"))


def _constant_value(tree: ast.Module, name: str) -> ast.expr | None:
    """Syntax tree of the value of a constant that a module of ltsim defines or imports; None if there is none."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            return node.value
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}:
            return _constant_value(_module_syntax_tree((node.module or "").removeprefix("ltsim.")), name)
    return None


def _documented_parameters(docstring: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Name of each parameter in the section `Parameters` of a docstring, with its type and description."""
    section = re.search(r"Parameters\n-+\n(.*?)(?:\n\n\S[^\n]*\n-+\n|\Z)", docstring, re.DOTALL)
    parameter_texts = re.split(r"\n(?=\S)", section[1]) if section else []
    for entry in parameter_texts:
        heading, _, text = entry.partition("\n")
        names, _, docstring_type = heading.partition(" : ")
        for name in names.split(","):
            yield name.strip(), (docstring_type, " ".join(text.split()))


def with_datum_in_frame(recording: Recording, frame: Path) -> Recording:
    """Recording whose datum is in the frame of a file or of a built-in scenario; raises RecordError or InputError."""
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
