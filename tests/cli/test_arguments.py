"""Python functions refuse what the command line refuses, with the same sentence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

import ltsim as lt
from ltsim.cli.main import run
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
    (lt.simulate, {"seed": 1.5}, [], "seed is 1.5, expected a whole number, 0 or more"),
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


def test_the_help_says_what_a_number_and_a_choice_may_be(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["view", "--help"]) == 0
    assert "[incidence|residual]" in capsys.readouterr().out
    assert run(["simulate", "--help"]) == 0
    assert "0 or more" in capsys.readouterr().out
