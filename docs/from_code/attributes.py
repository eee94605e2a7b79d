"""Table of the attributes of `sightings`, from which an effect computes its design: names, shapes and units."""

import ast
import inspect

from ltsim.scene.sightings import Sightings

HIDDEN = ("station_indices_by_name", "target_indices_by_name")
"""Attributes that only ltsim uses; the table omits them."""


def listed() -> dict[str, str]:
    """First sentence of the docstring of each public field and property of `Sightings`, by name.

    Consecutive fields without a docstring have the docstring below the last of them.
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
    """Markdown table of attributes with shape, unit and meaning."""
    lines = ["| `sightings.` | shape, unit, meaning |", "|---|---|"]
    return "\n".join(lines + [f"| `{name}` | {about} |" for name, about in listed().items()])
