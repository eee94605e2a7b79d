"""What the documentation takes from the code when it is built: a directive a kind of page, and formulas as MathML."""

from collections.abc import Callable
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from from_code import command_line, keys, mathml

MAKERS: dict[str, Callable[..., str]] = {
    "keys": keys.tables,
    "command-line": command_line.verbs,
}
"""Name of a directive, and the function that turns its arguments into Markdown."""


def directive(maker: Callable[..., str]) -> type[SphinxDirective]:
    """A directive that puts in what `maker` says."""

    class FromCode(SphinxDirective):
        optional_arguments = 4

        def run(self) -> list[nodes.Node]:
            return self.parse_text_to_nodes(maker(*self.arguments), allow_section_headings=True)

    return FromCode


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    for name, maker in MAKERS.items():
        app.add_directive(name, directive(maker))
    app.add_html_math_renderer("mathml", (mathml.inline, None), (mathml.block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
