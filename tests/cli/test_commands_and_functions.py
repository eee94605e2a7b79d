"""A verb of the command line is its public function: the same options with the same defaults, and no drift."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import fields
from enum import Enum
from typing import Any, get_args, get_type_hints

import pytest

import ltsim as lt
from ltsim.cli.estimation_options import CalibrateOptions
from ltsim.cli.main import COMMANDS, command_function
from ltsim.cli.options import FunctionOptions, typer_command
from ltsim.core.errors import InputError

TERMINAL = {"out", "force", "terminal", "show", "with_stations"}
"""Where results go and what is printed: the command's own affair."""
READING = {"format_name", "hint", "columns", "frame", "control"}
"""How a recording is read: in Python an argument of `lt.read`."""
ONLY_HERE: dict[str, set[str]] = {
    "check": {"watch"},
    "diagnose": {"fail_on_mismatch"},
    "history": {"each_set_up", "fail_on_change"},
    "inject": {"truth", "curve", "injections"},
    "recover": {"junit"},
    "simulate": {"truth"},
    "uncertainty": {"against"},
}
"""What only a command does: watching, exit statuses, files for other programs."""
ONLY_THERE: dict[str, set[str]] = {
    "accept": {"folder"},
    "calibrate": {"advise"},
    "convert": {"format", "hints"},
    "correct": {"allow_repeated"},
    "recover": {"progress"},
    "report": {"tell"},
    "uncertainty": {"recording"},
}
"""What only a program gives: callables, and what the command line reads from the place of a file."""
SPELLED = {"scale": "scaled", "source": None, "scenario": None, "second": None, "file": None, "sources": None}
OTHERS = {"demo", "effects", "examples", "campaign", "plan", "view", "report", "simulate"}
"""Verbs that say more than one function, or whose function is about objects."""
SAME = sorted(set(COMMANDS) - OTHERS)


def of_command(verb: str) -> dict[str, Any]:
    """Options of a verb with their defaults."""
    parameters = inspect.signature(typer_command(command_function(verb))).parameters
    return {name: parameter.default for name, parameter in parameters.items()}


def plain(value: Any) -> Any:
    """Nothing given is nothing given, in whatever form."""
    value = value.value if isinstance(value, Enum) else value
    return None if value in ((), [], "", False, inspect.Parameter.empty) else value


@pytest.mark.parametrize("verb", SAME)
def test_an_option_is_a_parameter_of_the_function_with_the_same_default(verb: str):
    parameters = inspect.signature(getattr(lt, verb)).parameters
    special_options = TERMINAL | READING | ONLY_HERE.get(verb, set()) | {"quiet", "as_json"}
    options = {SPELLED.get(k, k): v for k, v in of_command(verb).items() if k not in special_options}
    named = {name: p for name, p in parameters.items() if p.kind is not p.VAR_KEYWORD}
    open_ended = len(named) < len(parameters)
    taken = {k for k, p in named.items() if p.default is not p.empty} - ONLY_THERE.get(verb, set())
    for name, default in options.items():
        if name is None:
            continue
        assert name in named or open_ended, f"ltsim {verb} has {name}, lt.{verb} has not"
        if name in taken and name != "jobs":
            assert plain(default) == plain(named[name].default), name
    assert taken <= set(options), f"lt.{verb} has {taken - set(options)}, ltsim {verb} has not"


@pytest.mark.parametrize("name", [n for n in lt.__all__ if n not in ("effects", "errors", "Effect", "Hints")])
def test_every_parameter_is_documented_once_and_help_is_that_of_the_function(name: str):
    function = getattr(lt, name)
    assert inspect.isfunction(function)
    text = inspect.getdoc(function) or ""
    for parameter in inspect.signature(function).parameters:
        assert parameter in text, f"lt.{name} does not say what {parameter} is"


FUNCTIONS = {"demo": ["simulate"], "history": ["history", "adjust"], "inject": ["inject", "injection_curve"]}
"""Public functions that take the options of a verb, if they are not that of its name alone."""
CHECKED_OPTIONS = [
    (verb, kind, field.name)
    for verb in COMMANDS
    for kind in get_type_hints(command_function(verb)).values()
    if isinstance(kind, type) and issubclass(kind, FunctionOptions)
    for field in fields(kind)
]
"""Verb, class and name of each option that is an argument of a public function."""


def documented_parameters(function: Any) -> Iterator[tuple[str, tuple[str, str]]]:
    """Name, type and description of each parameter in the docstring of a public function."""
    section = re.search(r"Parameters\n-+\n(.*?)(?:\n\n\S[^\n]*\n-+\n|\Z)", inspect.getdoc(function) or "", re.DOTALL)
    assert section
    for entry in re.split(r"\n(?=\S)", section[1]):
        heading, _, text = entry.partition("\n")
        names, _, kind = heading.partition(" : ")
        for name in names.split(","):
            yield name.strip(), (kind, " ".join(text.split()))


def documented(function_name: str, name: str) -> tuple[str, str]:
    """Type and description of a parameter; where the docstring refers to another function, those given there."""
    kind, text = dict(documented_parameters(getattr(lt, function_name)))[name]
    other = re.search(r"[Aa]s of `(\w+)`", text)
    return documented(other[1], name) if other else (kind, text)


@pytest.mark.parametrize(("verb", "kind", "name"), CHECKED_OPTIONS, ids=lambda value: getattr(value, "__name__", value))
def test_the_help_of_an_option_is_the_description_of_the_parameter(verb: str, kind: type[FunctionOptions], name: str):
    function_name = next(f for f in FUNCTIONS.get(verb, [verb]) if name in inspect.signature(getattr(lt, f)).parameters)
    _, option, *_ = get_args(get_type_hints(kind, include_extras=True)[name])
    documented_type, text = documented(function_name, name)
    assert option.help == text.replace("`", "")
    if documented_type.startswith("{"):
        assert option.metavar == f"[{'|'.join(re.findall(r'`([^`]+)`', documented_type))}]"
    default = inspect.signature(getattr(lt, function_name)).parameters[name].default
    assert plain(getattr(kind, name)) == plain(default)


def test_options_are_the_arguments_of_the_function_and_those_not_given_keep_its_defaults():
    options = CalibrateOptions(hold=["beam-tilt=2.5"], without="a, b,a", with_effects=["head-sag"])
    arguments = options.arguments()
    assert arguments["hold"] == {"beam-tilt": 2.5}
    assert arguments["without"] == ("a", "b")
    assert arguments["with_effects"] == ("head-sag",)
    assert not {"datum", "prior", "box"} & arguments.keys()
    with pytest.raises(InputError, match="--hold beam-tilt: expected NAME=VALUE"):
        CalibrateOptions(hold=["beam-tilt"]).arguments()
