"""Attributes of `sightings`, of which a design of an effect is made: names, shapes and units from the class itself."""

import ast
import inspect

from ltsim.scene.sightings import Sightings

HIDDEN = ("station_ids", "target_ids")
"""Attributes that serve the library alone."""


def listed() -> dict[str, str]:
    """Public fields and properties of `Sightings` with the first sentence of what is said of them.

    Fields in a row share the text under the last of them.
    """
    (body,) = (node.body for node in ast.parse(inspect.getsource(Sightings)).body if isinstance(node, ast.ClassDef))
    found: dict[str, str] = {}
    waiting: list[str] = []
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            waiting.append(node.target.id)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and waiting:
            found |= dict.fromkeys(waiting, _first(str(node.value.value)))
            waiting = []
        elif isinstance(node, ast.FunctionDef) and any("property" in ast.unparse(d) for d in node.decorator_list):
            found[node.name] = _first(ast.get_docstring(node) or "")
    return {name: about for name, about in found.items() if not name.startswith("_") and name not in HIDDEN}


def _first(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split()).replace("|", "\\|")


def table() -> str:
    """Markdown: attribute, shape and unit."""
    lines = ["| `sightings.` | shape, unit, meaning |", "|---|---|"]
    return "\n".join(lines + [f"| `{name}` | {about} |" for name, about in listed().items()])
