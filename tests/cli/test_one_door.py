"""A verb of the command line is its public function: the same options with the same defaults, and no drift."""

from __future__ import annotations

import inspect
from enum import Enum
from typing import Any

import pytest

import ltsim as lt
from ltsim.cli.main import COMMANDS, command_function
from ltsim.cli.options import typer_command

TERMINAL = {"out", "force", "terminal", "show"}
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
    parameters = inspect.signature(typer_command(verb, command_function(verb))).parameters
    return {name: parameter.default for name, parameter in parameters.items()}


def plain(value: Any) -> Any:
    """Nothing given is nothing given, in whatever form."""
    value = value.value if isinstance(value, Enum) else value
    return None if value in ((), [], "", False, inspect.Parameter.empty) else value


@pytest.mark.parametrize("verb", SAME)
def test_an_option_is_a_parameter_of_the_function_with_the_same_default(verb: str):
    parameters = inspect.signature(getattr(lt, verb)).parameters
    own = TERMINAL | READING | ONLY_HERE.get(verb, set()) | {"quiet", "as_json"}
    options = {SPELLED.get(k, k): v for k, v in of_command(verb).items() if k not in own}
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


@pytest.mark.parametrize("name", [n for n in lt.__all__ if n not in ("effects", "errors", "Effect")])
def test_every_parameter_is_documented_once_and_help_is_the_functions_own(name: str):
    function = getattr(lt, name)
    assert inspect.isfunction(function)
    text = inspect.getdoc(function) or ""
    for parameter in inspect.signature(function).parameters:
        assert parameter in text, f"lt.{name} does not say what {parameter} is"
