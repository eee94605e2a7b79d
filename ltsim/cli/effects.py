"""Command `effects`: the catalogue of physical effects."""

import inspect
import textwrap
from typing import Annotated, Any

import typer

from ltsim.cli.terminal import Terminal
from ltsim.core.notation import align_columns
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects import CATALOGUE, Effect, catalogue_entry, find_effect
from ltsim.physics.effects.catalogue import BUILTIN_PROVIDER
from ltsim.physics.effects.effect import ShapeParameter

EffectNameArgument = Annotated[
    str | None, typer.Argument(metavar="[NAME]", help="Name of an effect; default a list of all.")
]

TEXT_WIDTH = 110
"""Largest length of a line of a catalogue entry [characters]."""
LABEL_WIDTH = 13
"""Width of the column of labels of a catalogue entry [characters]."""
CONVENTIONS_TEXT = (
    "Delta is the true value - the reading. az is positive counter-clockwise, el upward; d is the range; f is +1 on\n"
    "face 1 and -1 on face 2; D_r, D_t, D_v are lengths along the beam, to its left and upward. The correlations are\n"
    "between the residuals that two effects cause in the reference workshop. Two numbers are for measurements in one\n"
    "face and in two faces, as in (0.46, 0.95)."
)
"""Definition of the symbols in the equations of the catalogue."""


def effects(name: EffectNameArgument = None, *, terminal: Terminal) -> None:
    """List the physical effects that can be simulated, calibrated and diagnosed, or print the catalogue entry of NAME.

    Effects of other installed packages are listed last, with the name of the package.

    Example: ltsim effects station-settling
    """
    if name is not None:
        effect = find_effect(name)
        terminal.print_json(catalogue_entry_json(effect))
        terminal.print_text(catalogue_entry_text(effect))
        return
    terminal.print_json([catalogue_entry_json(effect) for effect in CATALOGUE])
    group = ""
    name_and_text_rows = [[effect.name, _title_and_cause(effect)] for effect in CATALOGUE]
    width = max(len(name) for name, _ in name_and_text_rows)
    for (name, text), registration in zip(name_and_text_rows, CATALOGUE.entries.values(), strict=True):
        if registration.group != group:
            group = registration.group
            terminal.print_text(f"\n{group}" if name != name_and_text_rows[0][0] else group)
        terminal.print_text(
            f"  {name:<{width}}  {text}"
            + (f" [{registration.provider}]" if registration.provider != BUILTIN_PROVIDER else "")
        )
    terminal.print_text(f"\n{len(name_and_text_rows)} effects. Details of an effect: ltsim effects NAME")


def _title_and_cause(effect: type[Effect]) -> str:
    """Title and physical cause of an effect, from its catalogue entry."""
    entry = catalogue_entry(effect)
    return f"{entry.title}: {entry.cause_description}"


def catalogue_entry_json(effect: type[Effect]) -> dict[str, Any]:
    """Catalogue entry of an effect as data for JSON."""
    registration, entry = CATALOGUE.entries[effect.name], catalogue_entry(effect)
    return {
        "name": effect.name,
        "group": registration.group,
        "origin": registration.provider,
        "title": entry.title,
        "cause": entry.cause_description,
        "law": entry.equation,
        **{name.lower().replace(" ", "_"): text for name, text in entry.sections()},
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
                "low": _to_display_unit(s.lower_bound, s),
                "high": _to_display_unit(s.upper_bound, s),
            }
            for s in effect.shape_parameters
        ],
    }


def _to_display_unit(si_value: float, shape_parameter: ShapeParameter) -> float:
    """Value [SI] of a shape constant, converted to its display unit."""
    return si_value / SI_PER_UNIT[shape_parameter.unit]


def catalogue_entry_text(effect: type[Effect]) -> str:
    """Catalogue entry of an effect as text."""
    entry, registration = catalogue_entry(effect), CATALOGUE.entries[effect.name]
    lines = [
        f"{effect.name}: {entry.title} ({registration.group})",
        "",
        f"{entry.cause_description[0].upper()}{entry.cause_description[1:]}.",
    ]
    lines += ["", entry.equation, ""]
    sections = [*entry.sections(), ("Acts on", ", ".join(effect.observables)), ("Scope", effect.scope)]
    sections += [("Stage", effect.stage.name.lower()), ("Base rate", f"{effect.base_rate:g} (1 is occasional)")]
    sections += [("Depends on", ", ".join(effect.covariates))] if effect.covariates else []
    sections += [("Comes from", registration.provider)] if registration.provider != BUILTIN_PROVIDER else []
    for name, text in sections:
        lines += textwrap.wrap(
            f"{name:<{LABEL_WIDTH}}{text}", TEXT_WIDTH, subsequent_indent=" " * LABEL_WIDTH, break_on_hyphens=False
        )
    if effect.parameters:
        rows = [
            [p.name, f"{p.prior_sigma / p.si_per_display_unit:.3g}", p.unit, p.description] for p in effect.parameters
        ]
        lines += ["", align_columns(["parameter", "plausible size", "unit", "meaning"], rows, n_text_columns=4)]
    if effect.shape_parameters:
        rows = [
            [
                s.name,
                f"{_to_display_unit(s.lower_bound, s):.4g} to {_to_display_unit(s.upper_bound, s):.4g}",
                s.unit,
                s.description,
            ]
            for s in effect.shape_parameters
        ]
        lines += ["", align_columns(["constant", "searched", "unit", "meaning"], rows, n_text_columns=4)]
    return "\n".join([*lines, "", CONVENTIONS_TEXT])
