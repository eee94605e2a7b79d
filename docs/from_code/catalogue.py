"""Catalogue of effects: each entry, its parameters, and its effect on the measured points of the paper's workshop."""

from functools import cache

import numpy as np
from matplotlib.figure import Figure

import ltsim as lt
from from_code.keys import markdown
from from_code.pictures import Pictures
from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects import CATALOGUE, Effect
from ltsim.physics.effects.descriptions import EffectDescription
from ltsim.reports.style import (
    BLUE,
    INK_COLOUR,
    ORANGE,
    add_legend,
    new_figure,
    set_grid,
    svg_data_uri,
    svg_text,
    with_figure_style,
)
from ltsim.scene.sightings import Sightings
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import simulate

AXES = {
    "azimuth": ("azimuth [°]", lambda s: s.azimuth / DEGREE),
    "elevation": ("elevation [°]", lambda s: s.elevation / DEGREE),
    "distance": ("range [m]", lambda s: s.range_),
    "time": ("time [min]", lambda s: s.time / 60.0),
    "incidence": ("incidence [°]", lambda s: s.incidence_angle / DEGREE),
    "height": ("height of the target [m]", lambda s: s.target_points[s.target, 2]),
}
SIDES = ("along the beam", "to its left", "upward")
SCENARIO, SEED = "paper-workshop-two-face", 1


def cards(pictures: Pictures, _lines: list[str]) -> str:
    """Markdown with a section per group of effects and a subsection per effect."""
    lines: list[str] = []
    group = ""
    for entry in CATALOGUE.entries.values():
        if entry.group != group:
            group = entry.group
            lines += ["", f"## {group[0].upper()}{group[1:]}", ""]
        lines += _card(EffectDescription.from_listed_effect(entry))
        lines += _signature(entry.effect_class, pictures)
    return "\n".join(lines)


def _card(effect: EffectDescription) -> list[str]:
    lines = ["", f"### {effect.name}", "", f"**{effect.title}**: {_text(effect.cause)}.", "", _law(effect.equation), ""]
    lines += [f"{label}\n: {_text(text)}\n" for label, text in effect.labelled_texts]
    sizes = [[f"`{p.name}`", f"{p.plausible_size:.3g}", p.unit, _text(p.meaning)] for p in effect.parameters]
    lines += ["", *markdown(["parameter", "plausible size", "unit", "meaning"], sizes)]
    shape_parameters = [
        [f"`{s.name}`", f"{s.lower_bound:.4g} to {s.upper_bound:.4g}", s.unit, _text(s.meaning)]
        for s in effect.constants
    ]
    return [*lines, "", *markdown(["shape parameter", "searched", "unit", "meaning"], shape_parameters)]


def _law(law: str) -> str:
    """Markdown of a formula text: indented lines as a code block, other lines as a paragraph."""
    if any(line.startswith(" ") for line in law.splitlines()):
        return f"```text\n{law}\n```"
    return _text(law)


def _text(text: str) -> str:
    """Text of a catalogue entry with escaped Markdown characters."""
    for sign in "\\`*_[<|$":
        text = text.replace(sign, "\\" + sign)
    return text


@cache
def _space() -> ResidualSpace:
    """Residual space of the paper's workshop in both faces: projection of reading changes on the residuals."""
    recording, _ = simulate(load_scenario(SCENARIO), SEED)
    adjustment = lt.adjust(recording).adjustment
    assert isinstance(adjustment, Adjustment)
    return ResidualSpace.from_adjustment(adjustment)


def _signature(kind: type[Effect], pictures: Pictures) -> list[str]:
    """Picture of an effect with its first parameter at plausible size, and the fraction that a network absorbs."""
    space = _space()
    sightings = space.sightings
    effects = kind.candidates(sightings)
    effect = effects[len(effects) // 2] if effects else None
    if effect is None or not np.any(moved := _displacement(effect, sightings)):
        return []
    first = space.whitened_design(effect)[:, :1]
    whole = float(np.sum(first**2))
    share = float(np.sum(space.project(first) ** 2)) / whole if whole else 0.0
    parameter, place = effect.parameters[0], ", ".join(effect.stations + effect.targets)
    words = (
        f"{parameter.prior_sigma / parameter.si_per_display_unit:.3g} {parameter.unit} of `{parameter.name}`"
        f"{f' at {place}' if place else ''}, seen from one station of the paper's workshop. "
        f"Poses and targets of the network absorb {100 * (1 - share):.0f} % of the squared changes of the readings."
    )
    address = svg_data_uri(svg_text(_figure(effect, sightings, moved)))
    picture = pictures.keep(f"effect-{kind.name}", address, f"signature of {kind.name}")
    return ["", picture, "", words, ""]


def _displacement(effect: Effect, sightings: Sightings) -> Floats:
    """Displacement (n, 3) [um] of the measured points by the first parameter at plausible size: along, left, upward."""
    size = np.zeros(len(effect.parameters))
    size[0] = effect.parameters[0].prior_sigma
    change = np.nan_to_num(effect.design(sightings) @ size)
    length, level = sightings.range_, np.cos(sightings.elevation)
    upward = np.where(sightings.face == 1, 1.0, -1.0)
    moved: Floats = np.stack([change[:, 0], change[:, 1] * length * level, change[:, 2] * length * upward], axis=1)
    return moved / MICROMETRE


@with_figure_style
def _figure(effect: Effect, sightings: Sightings, moved: Floats) -> Figure:
    """Figure with three panels over the covariate of the effect, for both faces of one station at which it acts."""
    name = next(
        (c for c in effect.covariates if c in AXES), "azimuth" if "azimuth" in effect.observables else "elevation"
    )
    title, axis = AXES[name]
    acts = np.any(moved != 0.0, axis=1)
    stations = sightings.station[acts]
    shown = sightings.station == np.bincount(stations).argmax()
    figure = new_figure(2.1)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    for k, ax in enumerate(panels):
        for face, colour in ((1, BLUE), (2, ORANGE)):
            rows = shown & (sightings.face == face)
            ax.scatter(axis(sightings)[rows], moved[rows, k], s=9, color=colour, linewidths=0, label=f"face {face}")
        ax.axhline(0.0, color=INK_COLOUR, linewidth=0.6)
        ax.set_title(SIDES[k])
        set_grid(ax, grid_axis="both")
    panels[1].set_xlabel(title)
    panels[0].set_ylabel("change of the point [µm]")
    add_legend(figure, panels)
    return figure
