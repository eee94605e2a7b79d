"""The page of the Python interface: every name of the front door, by Sphinx's autodoc."""

import inspect

import ltsim


def names() -> str:
    """Markdown: a directive of autodoc a name that can be called, in the order of `ltsim.__all__`."""
    lines: list[str] = []
    for name in ltsim.__all__:
        thing = getattr(ltsim, name)
        if inspect.isfunction(thing):
            lines += [f"## ltsim.{name}", "", "```{eval-rst}", f".. autofunction:: ltsim.{name}", "```", ""]
    return "\n".join(lines)
