"""`ltsim effects`: the catalogue, printed from the effects themselves."""

from __future__ import annotations

import inspect
import sys
from typing import Annotated, Any

import typer

from ltsim.cli.options import Json, Quiet
from ltsim.cli.terminal import Terminal, table
from ltsim.effects import CATALOGUE, Effect, find_effect
from ltsim.effects.effect import ShapeParameter
from ltsim.units import FACTOR

Name = Annotated[str | None, typer.Argument(metavar="[NAME]", help="One effect; without it all are listed.")]


def effects(name: Name = None, quiet: Quiet = False, as_json: Json = False) -> None:
    """List the physical effects that can be simulated, calibrated and diagnosed, or print the card of one.

    Example: ltsim effects station-settling
    """
    terminal = Terminal(quiet, as_json)
    if name is not None:
        effect = find_effect(name)
        terminal.answer(entry(effect))
        terminal.say(card(effect))
        return
    terminal.answer([entry(effect) for effect in CATALOGUE])
    rows = [[effect.name, str(effect.number), first_line(effect)] for effect in CATALOGUE]
    terminal.say(table(["effect", "no.", "what it is"], rows, left=3))
    terminal.say(f"\n{len(rows)} effects; numbers as in the physics catalogue. The card of one: ltsim effects NAME")


def first_line(effect: type[Effect]) -> str:
    """What the effect is, in a sentence."""
    return (inspect.getdoc(effect) or "").splitlines()[0]


def entry(effect: type[Effect]) -> dict[str, Any]:
    """The card of an effect for a program."""
    return {
        "name": effect.name,
        "number": effect.number,
        "stage": effect.stage.name.lower(),
        "scope": effect.scope,
        "observables": list(effect.observables),
        "covariates": list(effect.covariates),
        "meaning": first_line(effect),
        "parameters": [
            {"name": p.name, "unit": p.unit, "meaning": p.meaning, "plausible_size": p.prior_sigma / p.factor}
            for p in effect.parameters
        ],
        "shape": [
            {"name": s.name, "unit": s.unit, "meaning": s.meaning, "low": _shown(s.low, s), "high": _shown(s.high, s)}
            for s in effect.shape
        ],
    }


def _shown(value: float, shape: ShapeParameter) -> float:
    return value / FACTOR[shape.unit]


def card(effect: type[Effect]) -> str:
    """The card of an effect for a person."""
    about = inspect.getdoc(sys.modules[effect.__module__]) or ""
    lines = [f"{effect.name} ({effect.number})", "", about, ""]
    lines.append(f"acts on       {', '.join(effect.observables)}")
    lines.append(f"scope         {effect.scope}")
    lines.append(f"stage         {effect.stage.name.lower()}")
    if effect.covariates:
        lines.append(f"depends on    {', '.join(effect.covariates)}")
    if effect.parameters:
        rows = [[p.name, f"{p.prior_sigma / p.factor:.3g}", p.unit, p.meaning] for p in effect.parameters]
        lines += ["", table(["parameter", "plausible size", "unit", "meaning"], rows, left=4)]
    if effect.shape:
        rows = [[s.name, f"{_shown(s.low, s):.4g} to {_shown(s.high, s):.4g}", s.unit, s.meaning] for s in effect.shape]
        lines += ["", table(["constant", "searched", "unit", "meaning"], rows, left=4)]
    return "\n".join(lines)
