"""Options that several commands share, and options generated from the parameters of public functions."""

from __future__ import annotations

import ast
import inspect
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

import ltsim as lt
from ltsim.cli import streams
from ltsim.cli.places import OutputPlace, check_outputs
from ltsim.cli.terminal import Terminal
from ltsim.core.arguments import ARGUMENT_BOUNDS, MOVE_SYNTAX, bounded_parser, check_choice, range_text
from ltsim.core.errors import FLAG_SPELLINGS, RecordError, SetupError

if TYPE_CHECKING:
    from ltsim.recordings import Hints, Recording

Source = Annotated[
    Path, typer.Argument(metavar="REC", help="A recording: a folder, or a file in a format that is recognised.")
]
_IN_FILE = typer.Option("--calibration", metavar="FILE", help="A calibration.json, or its folder.")
CalibrationFile = Annotated[Path, _IN_FILE]
OptionalCalibrationFile = Annotated[Path | None, _IN_FILE]
Jobs = Annotated[
    int,
    typer.Option(
        "--jobs",
        "-j",
        parser=bounded_parser("jobs"),
        metavar=f"NUMBER: {range_text('jobs')}",
        help="Number of processes; the result does not depend on it.",
    ),
]
FormatName = Annotated[
    str | None, typer.Option("--format", metavar="NAME", help="Format of REC; default by its content.")
]
HintList = Annotated[
    list[str] | None,
    typer.Option(
        "--hint",
        metavar="KEY=VALUE",
        help="Interpretation of an ambiguous file: angle=gon, vertical=zenith, azimuth=clockwise, length=m, date=dmy, "
        "points=FILE, setup=FILE, station=NAME.",
    ),
]
ColumnMap = Annotated[
    str | None,
    typer.Option(
        "--columns",
        metavar="ROLE=HEADER[UNIT],...",
        help='Roles of the columns of a table, e.g. "target=Name,azimuth=Hz[gon],zenith=V[gon],distance=D[m]".',
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
        "sigma_z_mm); an empty coordinate is unknown. A point that the readings contradict is reported and not used.",
    ),
]


def names_of(listed: str | None) -> tuple[str, ...] | None:
    """Names from a comma-separated list; None for None."""
    return None if listed is None else tuple(dict.fromkeys(n.strip() for n in listed.split(",") if n.strip()))


def hints_of(pairs: list[str] | None, columns: str | None = None, *, growing: bool = False) -> Hints:
    """Hints from `KEY=VALUE` texts; raises RecordError for an invalid key or value."""
    from ltsim.recordings import Hints

    given: dict[str, Any] = {}
    kinds = {name: kind for name, kind in get_type_hints(Hints).items() if name not in ("columns", "incomplete_tail")}
    for pair in pairs or []:
        key, _, value = pair.partition("=")
        if key not in kinds or not value:
            raise RecordError(f"--hint {pair}: expected KEY=VALUE with a key among {', '.join(kinds)}")
        choices = get_args(get_args(kinds[key])[0])  # of `Literal[...] | None`
        if choices and value not in choices:
            raise RecordError(f"--hint {pair}: {key} can be {' or '.join(choices)}")
        given[key] = Path(value) if key in ("points", "setup") else value
    return Hints(**given, columns=columns, incomplete_tail=growing)


@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading a recording."""

    format_name: FormatName = None
    hint: HintList = None
    columns: ColumnMap = None

    def of(self, path: Path, *, growing: bool = False) -> Recording:
        """The recording at `path`, which may still be `growing`; raises RecordError."""
        from ltsim.recordings import read

        return read(path, format=self.format_name, hints=hints_of(self.hint, self.columns, growing=growing))

    def open(self, path: Path, terminal: Terminal) -> Recording:
        """The recording at `path`; its notes and its size are printed; raises RecordError."""
        recording = self.of(path)
        terminal.notes(recording.notes)
        terminal.say(recording.headline)
        return recording


@dataclass(frozen=True)
class ControlledReading(ReadingOptions):
    """Options for reading a recording with control points."""

    control: ControlFile = None

    def of(self, path: Path, *, growing: bool = False) -> Recording:
        """The recording, with the points of `control` if given; raises RecordError."""
        recording = super().of(path, growing=growing)
        if self.control is None:
            return recording
        from ltsim.adjustment.axes import with_control_points

        return with_control_points(recording, self.control)


@dataclass(frozen=True)
class FramedReading(ControlledReading):
    """Options for reading a recording with control points and the axes of the results."""

    frame: FrameFile = None

    def of(self, path: Path, *, growing: bool = False) -> Recording:
        """The recording, in the axes of `frame` if given; raises RecordError."""
        recording = super().of(path, growing=growing)
        return recording if self.frame is None else in_axes(recording, self.frame)


def command_of(name: str, verb: Callable[..., Any]) -> Callable[..., Any]:
    """Function for Typer: groups of options expanded, `**options` replaced by parameters of public functions.

    These are the parameters of `lt.NAME`, or of the functions in the annotation of `**options`, each optionally
    followed by the parameters to use; parameters that the verb declares itself are skipped.
    """
    hints = get_type_hints(verb, include_extras=True)
    groups: dict[str, Any] = {key: group for key, group in hints.items() if is_dataclass(group)}
    declared = inspect.signature(verb).parameters
    single: list[inspect.Parameter] = []
    taken: list[FunctionOption] = []
    for key, parameter in declared.items():
        if key in groups:
            kinds = get_type_hints(groups[key], include_extras=True)
            single += [_option(f.name, kinds[f.name], f.default) for f in fields(groups[key])]
        elif parameter.kind is parameter.VAR_KEYWORD:
            sources = [text.split() for text in get_args(hints[key])[1:]] or [[name]]
            taken = [
                o for source, *wanted in sources for o in function_options(source, wanted) if o.name not in declared
            ]
        else:
            single.append(_option(key, hints[key], parameter.default))
    outputs = list(_outputs(single))
    at = next((i for i, p in enumerate(single) if p.name in ("out", *ReadingOptions.__dataclass_fields__)), len(single))
    single[at:at] = [option.parameter for option in taken]

    def run(**given: Any) -> Any:
        places = ((flag, given[name], output) for name, flag, output in outputs if given[name] is not None)
        check_outputs(places, force=given.get("force", False))
        if given.get("as_json") and streams.output_is_closed():
            raise SetupError("--json prints to standard output, which is closed; open it, or omit --json")
        for key, group in groups.items():
            given[key] = group(**{f.name: given.pop(f.name) for f in fields(group)})
        return verb(**given | {option.name: option.value(given[option.name]) for option in taken})

    run.__doc__ = verb.__doc__
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in single}
    run.__signature__ = inspect.Signature(single)  # type: ignore[attr-defined]
    return run


def _outputs(options: list[inspect.Parameter]) -> Iterator[tuple[str, str, OutputPlace]]:
    """Options and arguments for outputs: name, spelling and annotation."""
    for option in options:
        marks: list[Any] = [mark for mark in get_args(option.annotation)[1:] if isinstance(mark, OutputPlace)]
        if marks:
            declared: Any = get_args(option.annotation)[1]
            flags = [word for word in (declared.default, *(declared.param_decls or ())) if str(word).startswith("--")]
            yield option.name, flags[0] if flags else declared.metavar, marks[0]


def _option(name: str, kind: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


PYTHON_ONLY = ("advise", "allow_repeated", "geometry", "about", "format", "hints", "callbacks")
"""Parameters of public functions that are not made into options."""
LARGEST = 1e12
"""Largest magnitude of a number in an option that is a mapping."""
SHORT = {"trials": "-n", "jobs": "-j"}
METAVARS = {"prior": "FILE|none", "with_effects": "EFFECT[:WHERE,...]", "calibrator": "'CMD {recording} {out}'"}


def _number(text: str) -> float:
    value = float(text)
    if not abs(value) <= LARGEST:
        raise ValueError
    return value


def _toml(text: str) -> Any:
    """Value of a TOML text; the text itself if it is not valid TOML."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _place(text: str) -> tuple[float, ...]:
    place = tuple(_number(part) for part in text.split(","))
    if len(place) not in (2, 3, 4):
        raise ValueError
    return place


MAPPINGS: dict[str, tuple[str, str, Callable[[str], Any]]] = {
    "hold": ("NAME=VALUE", "NAME=VALUE with a number, e.g. beam-tilt=2.5", _number),
    "tolerance": ("NAME=QUANTITY", "NAME=QUANTITY, such as beam-tilt='2 urad'", lambda text: text.strip("'\"")),
    "changes": ("KEY=VALUE", "KEY=VALUE, such as work.faces=2", _toml),
    "move": (
        "STATION=X,Y[,Z[,YAW]]",
        MOVE_SYNTAX,
        _place,
    ),
}
"""Options that are mappings: metavar, text for the error message, parser of a value."""


@dataclass(frozen=True)
class FunctionOption:
    """Parameter of a public function as an option: default from its signature, help from its docstring."""

    name: str
    kind: str
    default: Any
    help: str
    of: str
    """Type in the docstring, which may list choices."""

    @property
    def choices(self) -> list[str]:
        """Allowed values, if the docstring lists them: {`mm`, `m`}."""
        return re.findall(r"`([^`]+)`", self.of) if self.of.startswith("{") else []

    @property
    def flag(self) -> str:
        """Flag on the command line: `--noise-from-data`."""
        return FLAG_SPELLINGS.get(self.name, "--set" if self.name == "changes" else "--" + self.name.replace("_", "-"))

    @property
    def several(self) -> bool:
        """True if the option can be repeated."""
        return self.name in MAPPINGS or "Effect" in self.kind or self.kind.startswith("Sequence")

    @property
    def names(self) -> bool:
        """True if the value is a comma-separated list of names."""
        return not self.several and "Sequence[str]" in self.kind

    @property
    def parameter(self) -> inspect.Parameter:
        """The option as a parameter for Typer."""
        words = [self.flag, *([SHORT[self.name]] if self.name in SHORT else [])]
        kind: Any = float if "float" in self.kind else int if "int" in self.kind else str
        metavar = MAPPINGS[self.name][0] if self.name in MAPPINGS else METAVARS.get(self.name)
        if self.kind.startswith("bool"):
            kind = bool
            words = words if self.default is False else [f"{self.flag}/--no-{self.flag[2:]}"]
        elif self.choices:
            kind, metavar = str, f"[{'|'.join(self.choices)}]"
        elif self.names:
            metavar = "NAME,..."
        elif self.name in ARGUMENT_BOUNDS:
            metavar = f"NUMBER: {range_text(self.name)}"
        elif metavar is None:
            metavar = "FILE" if "Path" in self.kind else "NAME" if kind is str else "N"
        default = self.default
        if self.several or default is None or default == ():
            kind, default = (list[str] if self.several else kind) | None, None
        complete = (lambda: self.choices) if self.choices else None
        parser = bounded_parser(self.name) if self.name in ARGUMENT_BOUNDS else None
        option = typer.Option(*words, help=self.help, metavar=metavar, autocompletion=complete, parser=parser)
        return _option(self.name, Annotated[kind, option], default)

    def value(self, given: Any) -> Any:
        """Argument of the function from the value on the command line; raises SetupError for an invalid value."""
        if given is None or given == []:
            return self.default
        if self.choices:
            check_choice(self.name, given, self.choices)
        if self.name in MAPPINGS:
            return dict(self._pair(text) for text in given)
        if self.names:
            return names_of(given)
        return tuple(given) if self.several else given

    def _pair(self, text: str) -> tuple[str, Any]:
        _, form, read = MAPPINGS[self.name]
        key, _, value = (part.strip() for part in text.partition("="))
        try:
            if key and value:
                return key, read(value)
        except ValueError:
            pass
        raise SetupError(f"{self.flag} {text}: expected {form}")


def function_options(function: str, wanted: list[str]) -> list[FunctionOption]:
    """Keyword parameters of a public function, or the `wanted` ones.

    The source is parsed, not imported, so that help is fast.
    """
    tree = _source(lt._HOME[function])
    node = next(n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function)
    meanings = dict(_meanings(inspect.cleandoc(ast.get_docstring(node) or "")))
    options = []
    for argument, default in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True):
        name, kind = argument.arg, ast.unparse(argument.annotation or ast.Constant("str"))
        value = _constant(tree, default.id) if isinstance(default, ast.Name) else default
        if (wanted and name not in wanted) or name in PYTHON_ONLY or not isinstance(value, ast.Constant | ast.Tuple):
            continue
        of, text = meanings[name]
        if other := re.search(r"[Aa]s of `(\w+)`", text):
            like = {option.name: option for option in function_options(other[1], [name])}
            of, text = like[name].of, like[name].help
        options.append(FunctionOption(name, kind, ast.literal_eval(value), text.replace("`", ""), of))
    return options


def _source(module: str) -> ast.Module:
    """Syntax tree of a module of ltsim, named without the package."""
    return ast.parse((Path(lt.__file__).parent / f"{module.replace('.', '/')}.py").read_text("utf-8"))


def _constant(tree: ast.Module, name: str) -> ast.expr | None:
    """Value of a constant that a module of ltsim defines or imports from another one."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            return node.value
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}:
            return _constant(_source((node.module or "").removeprefix("ltsim.")), name)
    return None


def _meanings(docstring: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Names of the parameters in a numpy docstring, each with its type and text."""
    section = re.search(r"Parameters\n-+\n(.*?)(?:\n\n\S[^\n]*\n-+\n|\Z)", docstring, re.DOTALL)
    entries = re.split(r"\n(?=\S)", section[1]) if section else []
    for entry in entries:
        head, _, text = entry.partition("\n")
        names, _, of = head.partition(" : ")
        for name in names.split(","):
            yield name.strip(), (of, " ".join(text.split()))


def in_axes(recording: Recording, frame: Path) -> Recording:
    """The recording with its datum in the axes of a file or of a built-in scenario; raises RecordError, SetupError."""
    from ltsim.adjustment.axes import in_axes_of_points, in_axes_of_three
    from ltsim.recordings.coordinates import read_points
    from ltsim.recordings.settings import read_toml
    from ltsim.simulation.builtin import builtin_names

    if frame.exists() and str(frame) not in builtin_names():
        if frame.suffix.lower() != ".toml":
            return in_axes_of_points(recording, read_points(frame, strict=False).by_name, str(frame))
        named = read_toml(frame, "frame")
        if {"origin", "x_axis", "xy_plane"} <= named.keys():
            return in_axes_of_three(recording, *(str(named[key]) for key in ("origin", "x_axis", "xy_plane")))
    from ltsim.simulation.scenario import load_scenario
    from ltsim.simulation.workshop import planned_layout

    layout = planned_layout(load_scenario(str(frame)))
    return in_axes_of_points(recording, dict(zip(layout.target_names, layout.target_points, strict=True)), str(frame))
