"""How a statistic of a campaign is drawn over what the campaign varies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from ltsim.campaigns.design import Factor
from ltsim.campaigns.statistics import Results, Spread
from ltsim.pages.figures.campaign import MOST_LINES, MOST_PANELS, Mean, Swept, by_factor, by_setting
from ltsim.pages.words import typeset
from ltsim.units import BY_ENDING

Key = tuple[Any, ...]


def title(factor: Factor) -> str:
    """A factor as an axis calls it: `angle noise [arcsec]`."""
    plain = next((factor.name.removesuffix(e) for e in BY_ENDING if factor.name.endswith(e)), factor.name)
    unit = typeset(factor.unit)
    return plain.replace("_", " ") + (f" [{unit}]" if unit else "")


def short(factor: Factor, level: Any) -> str:
    """A factor with its value: `angle noise 0.2 arcsec`."""
    name, _, unit = title(factor).partition(" [")
    value = factor.words(level).removesuffix(f" {factor.unit}") if factor.unit else factor.words(level)
    return f"{name} {value} {unit.rstrip(']')}".rstrip()


def varied(results: Results) -> list[Factor]:
    """Factors that truly vary, those that change together with an earlier one left out."""
    kept: list[Factor] = []
    for factor in results.factors:
        own = _column(results, factor)
        if len(set(own)) > 1 and not any(_alike(own, _column(results, other)) for other in kept):
            kept.append(factor)
    return kept


def cell_words(results: Results) -> dict[int, str]:
    """What each cell is, in a few words."""
    factors = varied(results)
    said = [", ".join(short(f, level[f.name]) for f in factors) for level in results.levels]
    plain = "as the scenario" if len(said) == 1 else ""
    return {
        entry.cell: words or plain or entry.label for entry, words in zip(results.manifest.cells, said, strict=True)
    }


def _column(results: Results, factor: Factor) -> list[Any]:
    return [level[factor.name] for level in results.levels]


def _alike(one: Sequence[Any], other: Sequence[Any]) -> bool:
    """Whether each value of one comes with one value of the other."""
    pairs = len(set(zip(one, other, strict=True)))
    return pairs == len(set(one)) == len(set(other))


def drawn(
    results: Results, spreads: Sequence[Spread], label: str, published: float | None
) -> Iterator[tuple[str, Figure]]:
    """Figures of a statistic, each with words for its caption.

    A line over one factor where cells form a grid, dots over every range of a design, else a line of text a cell.
    """
    factors = varied(results)
    cells = len({tuple(level[f.name] for f in factors) for level in results.levels})
    of_grid = cells == len(results.levels) == math.prod(len(set(_column(results, f))) for f in factors)
    if factors and results.manifest.settings.get("design"):
        yield _clouds(results, factors, spreads, label, published)
    elif factors and of_grid and cells > 2:
        yield from _lines(results, factors, spreads, label, published)
    else:
        yield _list(results, spreads, label, published)


def _list(results: Results, spreads: Sequence[Spread], label: str, published: float | None) -> tuple[str, Figure]:
    names = cell_words(results)
    rows = [Mean(names[s.cell], s.method, s.mean, s.low, s.high, s.quantiles[1], s.quantiles[5]) for s in spreads]
    return _several(results), by_setting(rows, label=label, published=published)


def _several(results: Results) -> str:
    return f"Over {results.manifest.trials} trials a setting."


def _lines(
    results: Results, factors: Sequence[Factor], spreads: Sequence[Spread], label: str, published: float | None
) -> Iterator[tuple[str, Figure]]:
    along, across, panels = arranged(results, factors)
    rows = []
    for s in spreads:
        level = results.levels[s.cell]
        line = short(across, level[across.name]) if across else s.method
        rows.append(_swept(s, _place(along, level), line, ", ".join(short(f, level[f.name]) for f in panels)))
    names = list(dict.fromkeys(row.panel for row in rows))
    for first in range(0, len(names), MOST_PANELS):
        shown = names[first : first + MOST_PANELS]
        part = f" Panels {first + 1} to {first + len(shown)} of {len(names)}." if len(names) > MOST_PANELS else ""
        chosen = [row for row in rows if row.panel in shown]
        figure = by_factor(chosen, label=label, axis=title(along), published=published)
        yield _several(results) + part, figure


def arranged(results: Results, factors: Sequence[Factor]) -> tuple[Factor, Factor | None, list[Factor]]:
    """The factor along the lines, the one that tells lines apart (None: methods do), those of the panels."""
    levels = {f.name: len(set(_column(results, f))) for f in factors}
    along = max(factors, key=lambda f: (f.kind in ("number", "integer"), levels[f.name]))
    rest = [f for f in factors if f is not along]
    if len(results.manifest.methods) > 1 or not rest:
        return along, None, rest
    across = max(rest, key=lambda f: levels[f.name] if levels[f.name] <= MOST_LINES else 0)
    return along, across, [f for f in rest if f is not across]


def _place(factor: Factor, level: Mapping[str, Any]) -> float | str:
    value = level[factor.name]
    return float(value) if factor.kind in ("number", "integer") and value is not None else factor.words(value)


def _swept(s: Spread, x: float | str, line: str, panel: str) -> Swept:
    return Swept(x, line, panel, s.mean, s.low, s.high, s.quantiles[1], s.quantiles[5])


def _clouds(
    results: Results, factors: Sequence[Factor], spreads: Sequence[Spread], label: str, published: float | None
) -> tuple[str, Figure]:
    rows = [
        _swept(s, _place(factor, results.levels[s.cell]), s.method, title(factor))
        for factor in factors
        for s in spreads
    ]
    text = "Each mark is one setting, against each factor. " + _several(results)
    return text, by_factor(rows, label=label, axis="", published=published, joined=False)
