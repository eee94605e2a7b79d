"""Command `effects`: list of the catalogue of physical effects, and entries of single effects."""

from __future__ import annotations

import textwrap
from itertools import groupby
from typing import TYPE_CHECKING, Annotated

import typer

import ltsim as lt
from ltsim.cli.terminal import Terminal
from ltsim.core.notation import align_columns

if TYPE_CHECKING:
    from ltsim.core.results import Table
    from ltsim.physics.effects.descriptions import EffectDescription

EffectNameArgument = Annotated[
    str | None, typer.Argument(metavar="[NAME]", help="Name of an effect; default a list of all.")
]

CATALOGUE_ENTRY_WIDTH = 110
"""Largest length [characters] of a line in a printed catalogue entry."""
CATALOGUE_LABEL_WIDTH = 13
"""Width [characters] of the column of labels in a printed catalogue entry."""
CATALOGUE_CONVENTIONS_TEXT = (
    "Delta is the true value - the reading. az is positive counter-clockwise, el upward; d is the range; f is +1 on\n"
    "face 1 and -1 on face 2; D_r, D_t, D_v are lengths along the beam, to its left and upward. The correlations are\n"
    "between the residuals that two effects cause in the reference workshop. Two numbers are for measurements in one\n"
    "face and in two faces, as in (0.46, 0.95)."
)
"""Explanation of the signs, symbols and correlations in a catalogue entry of an effect, printed after the entry."""


def effects(name: EffectNameArgument = None, *, terminal: Terminal) -> None:
    """List the physical effects that can be simulated, calibrated and diagnosed, or print the catalogue entry of NAME.

    Effects of other installed packages are listed last, with the name of the package.

    Example: ltsim effects station-settling
    """
    listed = lt.catalogue() if name is None else lt.catalogue(name)
    entries = [effect.model_dump(mode="json") for effect in listed.descriptions]
    if name is not None:
        terminal.print_json(entries[0])
        tables = [listed.table(kind) for kind in ("parameters", "constants")]
        terminal.print_text(catalogue_entry_text(listed.descriptions[0], tables))
        return
    terminal.print_json(entries)
    width = max(len(effect.name) for effect in listed.descriptions)
    groups = groupby(listed.descriptions, lambda effect: effect.group)
    terminal.print_text(
        "\n\n".join(
            "\n".join([group, *(_effect_list_line(effect, width) for effect in members)]) for group, members in groups
        )
    )
    terminal.print_text(f"\n{len(entries)} effects. Details of an effect: ltsim effects NAME")


def _effect_list_line(effect: EffectDescription, name_width: int) -> str:
    """Line of the list of effects: name and summary, and for an effect of another package the name of the package."""
    origin = f" [{effect.external_provider}]" if effect.external_provider else ""
    return f"  {effect.name:<{name_width}}  {effect.summary}{origin}"


def catalogue_entry_text(effect: EffectDescription, tables: list[Table]) -> str:
    """Text of the catalogue entry of an effect, with the tables of its parameters and its shape parameters."""
    lines = [f"{effect.name}: {effect.title} ({effect.group})", "", f"{effect.cause[0].upper()}{effect.cause[1:]}."]
    lines += ["", effect.equation, ""]
    for label, text in effect.labelled_texts:
        lines += textwrap.wrap(
            f"{label:<{CATALOGUE_LABEL_WIDTH}}{text}",
            CATALOGUE_ENTRY_WIDTH,
            subsequent_indent=" " * CATALOGUE_LABEL_WIDTH,
            break_on_hyphens=False,
        )
    for table in tables:
        if table.rows:
            lines += ["", _text_without_effect_column(table)]
    return "\n".join([*lines, "", CATALOGUE_CONVENTIONS_TEXT])


def _text_without_effect_column(table: Table) -> str:
    """Text of a table without its first column, which holds the name of the effect."""
    rows = [cells[1:] for cells in table.displayed_cells()]
    return align_columns(table.headings[1:], rows, n_text_columns=len(table.headings) - 1)
