"""Blocks that several kinds share: residual figures, the floor plan, the 3D view, who stands where."""

from __future__ import annotations

from collections.abc import Sequence

from ltsim.arrays import Floats
from ltsim.calibration.schema import Combination, DeterminedEntry
from ltsim.pages import figures, style
from ltsim.pages.document import Block, Detail, Scene, Table, picture
from ltsim.pages.residuals import Residuals
from ltsim.pages.words import natural
from ltsim.pages.workshop import Workshop


def residual_blocks(after: Residuals, before: Residuals | None, *, what: str) -> list[Block]:
    """Residuals by station and against covariates; `what` names the difference between before and after."""
    compared = f" Grey: without {what}; blue: with." if before is not None else ""
    blocks: list[Block] = [
        picture(
            "Residuals by station",
            figures.residuals_by_station(after, before),
            "Observed minus adjusted reading of every pointing; the bar is the root mean square." + compared,
        )
    ]
    usual = [name for name in ("azimuth", "elevation", "distance", "time") if name in after.covariates]
    if usual:
        blocks.append(
            picture(
                "Residuals against what they might depend on",
                figures.residuals_by_covariate(after, before, covariates=usual),
                "Where the model holds, the running mean stays at zero within its band." + compared,
            )
        )
    return blocks


def workshop_blocks(workshop: Workshop, *, detail: Detail) -> list[Block]:
    """The floor plan and the 3D view, as far as `detail` asks for them."""
    if detail == "none":
        return []
    return [
        picture(
            "Floor plan",
            figures.floor_plan(workshop),
            "Seen from above. No reflector may stand on the floor inside a shadow circle: the elevation limit of that "
            "station hides it. " + " ".join(workshop.notes),
        ),
        scene(workshop, interactive=detail == "turn"),
    ]


def scene(workshop: Workshop, *, interactive: bool) -> Scene:
    """The 3D view; only an interactive one carries the page to turn."""
    from ltsim.pages import scene3d  # pyvista takes a second to load, and only this needs it
    from ltsim.pages.scene_page import scene_page

    coloured = workshop.coloured("incidence")
    png, legend = scene3d.picture_and_legend(coloured)
    lines = "; ".join(line.rstrip(".") for line in legend.lines)
    by = f" Lines of sight are coloured by {coloured.sights.label}." if coloured.sights else ""
    return Scene(
        title="The workshop in 3D",
        png=style.webp_uri(png),
        caption=f"{lines[:1].upper()}{lines[1:]}.{by}",
        page=scene_page(coloured) if interactive else "",
    )


def undetermined(title: str, entries: Sequence[Combination], *, decimals: int, note: str = "") -> list[Block]:
    """Combinations of parameters that stay open, and the cure of each."""
    rows = [
        [
            " ".join(f"{'+' if c >= 0 else '−'} {abs(c):.2f} {name}" for name, c in entry.combination.items()),
            entry.cure or "–",
            "–" if entry.gain is None else f"{100 * entry.gain:.{decimals}f} %",
        ]
        for entry in entries
    ]
    header = ["combination, in units of the prior σ", "what would determine it", "told"]
    return [Table(title, header, rows, text_columns=2, note=note)] if rows else []


def combined(title: str, entries: Sequence[DeterminedEntry]) -> list[Block]:
    """Combinations of parameters that are known far better than each of them."""
    rows = [
        [f"{entry.terms} ({entry.instrument})" if entry.instrument else entry.terms,
         style.with_unit(entry.value, entry.sigma, entry.unit)]
        for entry in entries
    ]  # fmt: skip
    note = "Together they are known far better than each of them."
    return [Table(title, ["combination", "value"], rows, text_columns=2, note=note)] if rows else []


def station_table(names: tuple[str, ...], position: Floats, sigma: Floats | None, *, note: str) -> Table:
    """Positions (S, 3) [m] and their standard deviations."""
    header = ["station", "x [mm]", "y [mm]", "z [mm]"]
    rows = [[name, *(style.fixed(1e3 * v, 3) for v in place)] for name, place in zip(names, position, strict=True)]
    if sigma is not None:
        header += ["σx [µm]", "σy [µm]", "σz [µm]"]
        rows = [row + [style.number(1e6 * s, 2) for s in spread] for row, spread in zip(rows, sigma, strict=True)]
    return Table("Stations", header, rows, note=note)


def target_table(names: tuple[str, ...], points: Floats, sigma: Floats, *, note: str) -> Table:
    """Coordinates (T, 3) [m] and their standard deviations."""
    order = sorted(range(len(names)), key=lambda i: natural(names[i]))
    rows = [
        [names[i], *(style.fixed(1e3 * v, 4) for v in points[i]), *(style.number(1e6 * s, 2) for s in sigma[i])]
        for i in order
    ]
    header = ["target", "x [mm]", "y [mm]", "z [mm]", "σx [µm]", "σy [µm]", "σz [µm]"]
    return Table("Targets", header, rows, note=note)
