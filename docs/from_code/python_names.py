"""Page of the Python interface: every public name of `ltsim` and every class of results, by autodoc of Sphinx."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from pkgutil import walk_packages

import ltsim
from ltsim.core.results import Column, Result, Table


def names() -> str:
    """Markdown with an autodoc directive per name of `ltsim.__all__`, followed by the classes of results."""
    lines: list[str] = []
    for name in ltsim.__all__:
        public = getattr(ltsim, name)
        if not inspect.ismodule(public):
            directive = "autofunction" if inspect.isfunction(public) else "autoclass"
            lines += [f"## ltsim.{name}", "", "```{eval-rst}", f".. {directive}:: ltsim.{name}", "```", ""]
    lines += [
        "## Results",
        "",
        "Result classes of the functions. They all inherit the methods of `Result`.",
        "",
    ]
    for module in walk_packages(ltsim.__path__, "ltsim."):
        import_module(module.name)
    kinds = sorted(set(_below(Result)), key=lambda kind: kind.__name__)
    for kind in (Result, *kinds, Table, Column):
        path, own = f"{kind.__module__}.{kind.__qualname__}", ", ".join(_told(kind))
        members = [f"   :members: {own}"] if own else []
        lines += [f"### {kind.__name__}", "", "```{eval-rst}", f".. autoclass:: {path}", *members, "```", ""]
    return "\n".join(lines)


def _below(kind: type) -> Iterator[type]:
    """All subclasses of `kind` that belong to ltsim."""
    for own in kind.__subclasses__():
        if own.__module__.startswith("ltsim."):
            yield own
        yield from _below(own)


def _told(kind: type) -> list[str]:
    """Public methods and properties that a class defines with a docstring."""
    declared = {name: thing for name, thing in vars(kind).items() if not name.startswith("_")}
    methods = {name for name, thing in declared.items() if inspect.isfunction(thing) or isinstance(thing, property)}
    return [name for name in declared if name in methods and inspect.getdoc(declared[name])]
