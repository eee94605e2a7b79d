"""Command `effects`: the catalogue of physical effects."""

import inspect
import textwrap
from typing import Annotated, Any

import typer

from ltsim.cli.terminal import Terminal
from ltsim.core.notation import align_columns
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects import CATALOGUE, Effect, catalogue_entry, find_effect
from ltsim.physics.effects.catalogue import BUILTIN_ORIGIN
from ltsim.physics.effects.effect import ShapeParameter

Name = Annotated[str | None, typer.Argument(metavar="[NAME]", help="Name of an effect; default a list of all.")]

WIDTH = 110
INDENT = 13
CONVENTIONS = (
    "Delta is truth - reading. az counts counter-clockwise, el from the horizontal plane, d is the range; f is +1 on\n"
    "face 1 and -1 on face 2; D_r, D_t, D_v are lengths along the beam, to its left and upward. Two numbers, as in\n"
    "0.46 / 0.95, are correlations of the residuals in the reference workshop in one face and in two."
)


def effects(name: Name = None, *, terminal: Terminal) -> None:
    """List the physical effects that can be simulated, calibrated and diagnosed, or print the entry of one.

    Effects of other installed packages are listed last, with the name of the package.

    Example: ltsim effects station-settling
    """
    if name is not None:
        effect = find_effect(name)
        terminal.answer(entry(effect))
        terminal.say(card(effect))
        return
    terminal.answer([entry(effect) for effect in CATALOGUE])
    group = ""
    rows = [[effect.name, _about(effect)] for effect in CATALOGUE]
    width = max(len(name) for name, _ in rows)
    for (name, about), listed in zip(rows, CATALOGUE.entries.values(), strict=True):
        if listed.group != group:
            group = listed.group
            terminal.say(f"\n{group}" if name != rows[0][0] else group)
        terminal.say(
            f"  {name:<{width}}  {about}" + (f" [{listed.provider}]" if listed.provider != BUILTIN_ORIGIN else "")
        )
    terminal.say(f"\n{len(rows)} effects. Details of an effect: ltsim effects NAME")


def _about(effect: type[Effect]) -> str:
    card = catalogue_entry(effect)
    return f"{card.title}: {card.cause_description}"


def entry(effect: type[Effect]) -> dict[str, Any]:
    """Catalogue entry of an effect as data for JSON."""
    listed, about = CATALOGUE.entries[effect.name], catalogue_entry(effect)
    return {
        "name": effect.name,
        "group": listed.group,
        "origin": listed.provider,
        "title": about.title,
        "cause": about.cause_description,
        "law": about.equation,
        **{name.lower().replace(" ", "_"): text for name, text in about.sections()},
        "stage": effect.stage.name.lower(),
        "scope": effect.scope,
        "observables": list(effect.observables),
        "covariates": list(effect.covariates),
        "meaning": inspect.cleandoc(effect.__doc__ or "").partition("\n")[0],
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "meaning": p.description,
                "plausible_size": p.prior_sigma / p.si_per_display_unit,
            }
            for p in effect.parameters
        ],
        "shape": [
            {
                "name": s.name,
                "unit": s.unit,
                "meaning": s.description,
                "low": _shown(s.lower_bound, s),
                "high": _shown(s.upper_bound, s),
            }
            for s in effect.shape_parameters
        ],
    }


def _shown(value: float, shape: ShapeParameter) -> float:
    return value / SI_PER_UNIT[shape.unit]


def card(effect: type[Effect]) -> str:
    """Catalogue entry of an effect as text."""
    about, listed = catalogue_entry(effect), CATALOGUE.entries[effect.name]
    lines = [
        f"{effect.name}: {about.title} ({listed.group})",
        "",
        f"{about.cause_description[0].upper()}{about.cause_description[1:]}.",
    ]
    lines += ["", about.equation, ""]
    sections = [*about.sections(), ("Acts on", ", ".join(effect.observables)), ("Scope", effect.scope)]
    sections += [("Stage", effect.stage.name.lower())]
    sections += [("Depends on", ", ".join(effect.covariates))] if effect.covariates else []
    sections += [("Comes from", listed.provider)] if listed.provider != BUILTIN_ORIGIN else []
    for name, text in sections:
        lines += textwrap.wrap(f"{name:<{INDENT}}{text}", WIDTH, subsequent_indent=" " * INDENT, break_on_hyphens=False)
    if effect.parameters:
        rows = [
            [p.name, f"{p.prior_sigma / p.si_per_display_unit:.3g}", p.unit, p.description] for p in effect.parameters
        ]
        lines += ["", align_columns(["parameter", "plausible size", "unit", "meaning"], rows, text_columns=4)]
    if effect.shape_parameters:
        rows = [
            [s.name, f"{_shown(s.lower_bound, s):.4g} to {_shown(s.upper_bound, s):.4g}", s.unit, s.description]
            for s in effect.shape_parameters
        ]
        lines += ["", align_columns(["constant", "searched", "unit", "meaning"], rows, text_columns=4)]
    return "\n".join([*lines, "", CONVENTIONS])
