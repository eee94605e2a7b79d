"""The scenarios that come with ltsim: their names and files, without loading what reads them."""

import difflib
from importlib.resources import files
from pathlib import Path

from ltsim.core.errors import SetupError
from ltsim.recordings.files import shown


def builtin_names() -> tuple[str, ...]:
    """Names of the built-in scenarios."""
    folder = files(__name__)
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")))


def builtin_path(name: str) -> Path:
    """The file of a built-in scenario.

    Raises SetupError when there is none of this name; the message names the closest ones.
    """
    names = builtin_names()
    if name not in names:
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.5) or names
        message = "there is no such file, and no built-in scenario of this name"
        raise SetupError(f"{shown(name)}: {message}; did you mean {', '.join(near)}?")
    return Path(str(files(__name__) / f"{name}.toml"))


def builtin_text(name: str) -> str:
    """The commented file of a built-in scenario, to print and edit; raises SetupError."""
    return builtin_path(name).read_text(encoding="utf-8")
