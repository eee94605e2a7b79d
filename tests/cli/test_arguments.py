"""Python functions refuse what the command line refuses, with the same sentence."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import pytest

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.arguments import ARGUMENT_BOUNDS
from ltsim.core.errors import LtsimError

SMALL = {"scenario": "paper-workshop", "trials": 2, "methods": [{"name": "network"}]}
WRONG: list[tuple[Callable[..., Any], dict[str, Any], list[str], str]] = [
    (lt.simulate, {"seed": -1}, ["simulate", "paper-workshop", "--seed=-1"], "seed is -1, expected a whole"),
    (lt.simulate, {"trial": -2}, ["simulate", "paper-workshop", "--trial=-2"], "trial is -2, expected a"),
    (lt.plan, {"starts": 0}, ["plan", "paper-workshop", "--starts=0"], "starts is 0, expected a whole number"),
    (lt.plan, {"seed": -1}, ["plan", "paper-workshop", "--seed=-1"], "seed is -1, expected a whole number, 0 or more"),
    (lt.campaign, {"source": SMALL, "out": "x", "jobs": 0}, [], "jobs is 0, expected a whole number, 1 to 256"),
    (lt.recover, {"source": "paper-workshop", "trials": 1}, ["recover", "paper-workshop", "-n", "1"], "trials is 1"),
    (lt.view, {"source": "paper-workshop", "colour": "red"}, ["view", "paper-workshop", "--colour=red", "--png=a.png"],
     "colour is red, expected incidence or residual"),
    (lt.view, {"source": "paper-workshop", "cad_up": "x"}, ["view", "paper-workshop", "--cad-up=x", "--png=a.png"],
     "is x, expected y or z"),
    (lt.view, {"source": "paper-workshop", "cad_unit": "ft"}, ["view", "paper-workshop", "--cad-unit=ft", "--png=a"],
     "is ft, expected mm or m or in"),
    (lt.simulate, {"geometry": "own"}, [], "geometry is own, expected shared or per-trial"),
    (lt.simulate, {"geometry": None}, [], "geometry is None, expected shared or per-trial"),
    (lt.simulate, {"seed": 1.5}, ["simulate", "paper-workshop", "--seed=1.5"], "seed is 1.5, expected a whole number"),
    (lt.simulate, {"seed": "x"}, ["simulate", "paper-workshop", "--seed=x"], "seed is x, expected a whole number, 0"),
    (lt.simulate, {"seed": True}, [], "seed is True, expected a whole number"),
    (lt.simulate, {"seed": None}, [], "seed is None, expected a whole number"),
    (lt.simulate, {"changes": 3}, [], "changes is 3, expected a mapping"),
    (lt.simulate, {"source": ""}, ["simulate", ""], "the source is '', expected the path of a file or folder"),
    (lt.simulate, {"source": None}, [], "the source is None, expected the path of a file or folder"),
    (lt.simulate, {"source": "ghost"}, ["simulate", "ghost"], "ghost: there is no such file"),
    (lt.plan, {"source": ""}, ["plan", ""], "the source is '', expected the path of a file or folder"),
    (lt.plan, {"source": 3}, [], "the source is 3, expected the path of a file or folder"),
    (lt.plan, {"source": "ghost"}, ["plan", "ghost"], "ghost: there is no such file"),
    (lt.plan, {"jobs": 0}, ["plan", "paper-workshop", "--jobs=0"], "jobs is 0, expected a whole number, 1 to 256"),
    (lt.plan, {"jobs": 999}, ["plan", "paper-workshop", "-j", "999"], "jobs is 999, expected a whole number, 1 to 256"),
    (lt.plan, {"jobs": None}, [], "jobs is None, expected a whole number"),
    (lt.plan, {"move": 3}, [], "move is 3, expected a mapping"),
    (lt.plan, {"move": {"S9": [1, 2]}}, ["plan", "paper-workshop", "--move", "S9=1,2"], "no station called 'S9'"),
    (lt.plan, {"move": {"S1": [1]}}, ["plan", "paper-workshop", "--move", "S1=1"], "S1=1: expected STATION=X,Y or"),
    (lt.plan, {"move": {"S1": ["a", "b"]}}, ["plan", "paper-workshop", "--move", "S1=a,b"], "S1=a,b: expected STATION"),
    (lt.plan, {"move": {"S1": [1, float("nan")]}}, ["plan", "paper-workshop", "--move", "S1=1,nan"],
     "S1=1,nan: expected STATION=X,Y or"),
    (lt.campaign, {"source": None}, [], "the source is None, expected the path of a file or folder"),
    (lt.campaign, {"source": "ghost"}, ["campaign", "ghost"], "ghost: there is no such file"),
    (lt.campaign, {"source": SMALL, "out": "x", "jobs": None}, [], "jobs is None, expected a whole number"),
    (lt.campaign, {"source": SMALL, "out": "x", "backend": "slurm"}, ["campaign", "a.toml", "--backend=slurm"],
     "backend is slurm, expected local or dask"),
    (lt.campaign, {"source": SMALL, "out": "x", "scheduler": "host"}, ["campaign", "a.toml", "--scheduler=host"],
     "scheduler is host, which needs"),
    (lt.campaign, {"source": SMALL, "out": "x", "changes": 3}, [], "changes is 3, expected a mapping"),
    (lt.campaign, {"source": SMALL, "out": f"{__file__}"}, ["campaign", "a.toml", "--out", f"{__file__}"],
     "the path is a file, expected a folder to write to"),
    (lt.recover, {"source": "paper-workshop", "jobs": 0}, ["recover", "paper-workshop", "-j0"], "jobs is 0, expected"),
    (lt.view, {"source": ""}, ["view", "", "--png=a.png"], "the source is '', expected the path of a file or folder"),
    (lt.view, {"source": None}, [], "the source is None, expected the path of a file or folder"),
    (lt.diagnose, {"recording": "ghost", "level": 1e-5}, ["diagnose", "ghost", "--level=1e-5"], "level is 1e-05, "),
    (lt.view, {"source": "ghost"}, ["view", "ghost", "--png=a.png"], "ghost: there is no such file"),
    (lt.view, {"source": "paper-workshop", "colour": None}, [], "colour is None, expected incidence or residual"),
    (lt.view, {"source": "paper-workshop", "cad": "no.stl"}, ["view", "paper-workshop", "--cad=no.stl", "--png=a.png"],
     "no.stl: "),
    (lt.plan, {"move": {"S1": [1e300, 1]}}, ["plan", "paper-workshop", "--move", "S1=1e300,1"], "1: expected STATION="),
    (lt.plan, {"move": {"": [1, 2]}}, ["plan", "paper-workshop", "--move", "=1,2"], ": expected STATION=X,Y or"),
    (lt.simulate, {"changes": {"": 1}}, [], "changes =1: expected KEY=VALUE"),
    (lt.campaign, {"source": SMALL, "out": "x", "changes": {"": 1}}, ["campaign", "a.toml", "--set", "=1"],
     "=1: expected KEY=VALUE"),
    (lt.campaign, {"source": SMALL, "out": "x", "backend": "dask"}, ["campaign", "a.toml", "--backend=dask"],
     ", an address such as tcp://127.0.0.1:8786 or a cluster file"),
    (lt.campaign, {"source": SMALL | {"stop": {"statistic": "speed", "max_half_width": 1.0}}, "out": "x"}, [],
     "stop.statistic: there is no column of the rows called 'speed'"),
    (lt.campaign, {"source": ""}, ["campaign", ""], "the source is '', expected the path"),
    (lt.campaign, {"source": "a\0b"}, ["campaign", "a\0b"], "the source is 'a\\x00b', expected the path"),
    (lt.campaign, {"source": "..", "out": "x"}, ["campaign", "..", "--out=x"], "..: the path is a folder, expected a"),
    (lt.campaign, {"source": "."}, ["campaign", "."], ".: the path is a folder, expected a file"),
    (lt.campaign, {"source": SMALL, "out": 5}, [], "out is 5, expected a path"),
    (lt.campaign, {"source": SMALL, "out": "a\0b"}, [], "expected a path"),
    (lt.view, {"source": "paper-workshop", "cad": 5}, [], "cad is 5, expected a path"),
    (lt.view, {"source": "paper-workshop", "cad": "a\0.stl"},
     ["view", "paper-workshop", "--cad=a\0.stl", "--png=a.png"], "a\\x00.stl'"),
    (lt.recover, {"source": "paper-workshop", "method": "guess"}, ["recover", "paper-workshop", "--method=guess"],
     "method is guess, expected network or distance or"),
    (lt.recover, {"source": "paper-workshop", "errors": "known"}, ["recover", "paper-workshop", "--errors=known"],
     "errors is known, expected drawn or stated"),
    (lt.recover, {"source": "paper-workshop", "calibrator": 5}, [], "calibrator is 5, expected a command or"),
    (lt.calibrate, {"recording": "ghost", "method": "guess"}, ["calibrate", "ghost", "--method=guess"],
     "method is guess, expected network or distance or"),
    (lt.simulate, {"trial": 10**13}, ["simulate", "paper-workshop", "--trial=10000000000000"],
     "trial is 10000000000000, expected a whole number, 0 to"),
    (lt.recover, {"source": "paper-workshop", "tolerance": 3}, [], "tolerance is 3, expected a mapping"),
    (lt.calibrate, {"recording": "ghost", "hold": 3}, [], "hold is 3, expected a mapping"),
    (lt.read, {"path": "ghost", "hints": 3}, [], "hints is 3, expected a mapping"),
    (lt.read, {"path": "ghost", "hints": {"points": 3}}, [], "hints points=3: points can be a path"),
    (lt.read, {"path": "ghost", "hints": {"azimuth": "left"}}, ["convert", "ghost", "x", "--hint=azimuth=left"],
     "azimuth=left: azimuth can be clockwise or counter-clockwise"),
    (lt.convert, {"source": "ghost", "destination": "x", "hints": {"unit": "gon"}},
     ["convert", "ghost", "x", "--hint=unit=gon"],
     "unit=gon: expected KEY=VALUE with a key among angle, vertical, azimuth, length, points, station, columns, "),
]  # fmt: skip


@pytest.mark.parametrize(("function", "given", "command", "sentence"), WRONG)
def test_the_same_sentence(
    function: Callable[..., Any], given: dict[str, Any], command: list[str], sentence: str,
    capsys: pytest.CaptureFixture[str], tmp_path: Any, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LtsimError) as problem:
        function(**given)
    assert sentence in str(problem.value)
    if command:
        assert run([*command, *(["--out=o"] if command[0] == "simulate" else [])]) == 2
        assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


BOUNDED = [
    (name, argument)
    for name in dir(lt)
    if inspect.isfunction(getattr(lt, name))
    for argument in inspect.signature(getattr(lt, name)).parameters
    if argument in ARGUMENT_BOUNDS
]


@pytest.mark.parametrize(("name", "argument"), BOUNDED)
def test_every_function_checks_its_numbers_first(name: str, argument: str) -> None:
    function = getattr(lt, name)
    needed = [
        p.name
        for p in inspect.signature(function).parameters.values()
        if p.default is inspect.Parameter.empty and p.kind is not inspect.Parameter.VAR_POSITIONAL
    ]
    with pytest.raises(LtsimError, match="is -1, expected a"):
        function(**dict.fromkeys(needed, "ghost") | {argument: -1})


def test_the_help_says_what_a_number_and_a_choice_may_be(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["view", "--help"]) == 0
    assert "[incidence|residual]" in capsys.readouterr().out
    assert run(["simulate", "--help"]) == 0
    assert "0 or more" in capsys.readouterr().out
