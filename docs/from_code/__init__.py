"""Sphinx directives that generate parts of the documentation from the code, and formulas as MathML.

Each directive turns its arguments into Markdown: tables of keys from the models, commands with their help, entries of
the catalogue, public names, and pictures from commands that are run.
"""

from collections.abc import Callable
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from from_code import attributes, catalogue, command_line, drawn, gallery, keys, mathml, python_names, results
from from_code.pictures import Pictures
from ltsim.recordings import FORMATS
from ltsim.recordings.specification import data_sheet_names, data_sheet_values


def formats() -> str:
    """Markdown table of the formats that are read and written."""
    lines = ["| `--format` | format | can be written with `--to` |", "|---|---|---|"]
    lines += [f"| `{f.name}` | {f.description} | {'yes' if f.write else ''} |" for f in FORMATS]
    return "\n".join(lines)


def data_sheets() -> str:
    """Markdown table of the built-in data sheets; a question mark is a value that a data sheet does not give."""
    header = "| name | MPE across the beam | MPE along the beam | MPE of the range offset | source |"
    lines = [header, "|---|---|---|---|---|"]
    for name in data_sheet_names():
        stated = data_sheet_values(name)
        across, along = (
            " + ".join(
                f"{stated[key]:g} {unit}" if key in stated else "?"
                for key, unit in ((f"{part}_limit_um", "µm"), (f"{part}_limit_um_per_m", "µm/m"))
            )
            for part in ("transverse", "range")
        )
        zero = f"{stated['range_offset_limit_um']:g} µm" if "range_offset_limit_um" in stated else ""
        lines.append(f"| `{name}`<br>{stated['name']} | {across} | {along} | {zero} | {stated['source']} |")
    return "\n".join(lines)


Maker = Callable[..., str]
MAKERS: dict[str, Maker] = {
    "keys": keys.tables,
    "dotted-keys": keys.dotted,
    "results": results.files,
    "formats": formats,
    "data-sheets": data_sheets,
    "sightings": attributes.table,
    "command-line": command_line.verbs,
    "python-names": python_names.names,
}
DRAWING_MAKERS: dict[str, Maker] = {"catalogue": catalogue.cards, "gallery": gallery.shown, "drawn": drawn.shown}
"""Makers that also get the folder for pictures and the lines of the directive."""


def directive(maker: Maker, *, draws: bool) -> type[SphinxDirective]:
    """Sphinx directive that inserts the Markdown that `maker` returns."""

    class FromCode(SphinxDirective):
        optional_arguments = 4
        has_content = True

        def run(self) -> list[nodes.Node]:
            place = (Pictures.of(self.env), list(self.content)) if draws else ()
            return self.parse_text_to_nodes(maker(*place, *self.arguments), allow_section_headings=True)

    return FromCode


def setup(app: Sphinx) -> dict[str, Any]:
    """Registration of the extension; Sphinx calls this function."""
    for makers, draws in ((MAKERS, False), (DRAWING_MAKERS, True)):
        for name, maker in makers.items():
            app.add_directive(name, directive(maker, draws=draws))
    app.add_html_math_renderer("mathml", (mathml.inline, None), (mathml.block, None))
    app.connect("build-finished", results.write_schemas)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
