"""Names and files of the built-in scenarios, in a module that imports quickly because it reads no scenario."""

import difflib
from importlib.resources import files
from pathlib import Path

from ltsim.core.errors import InputError
from ltsim.recordings.files import safe_excerpt


def builtin_names() -> tuple[str, ...]:
    """Names of the built-in scenarios."""
    folder = files(__name__)
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")))


def builtin_path(scenario_name: str) -> Path:
    """File of a built-in scenario; InputError with similar names for an unknown name."""
    names = builtin_names()
    if scenario_name not in names:
        near = difflib.get_close_matches(scenario_name, names, n=3, cutoff=0.5) or names
        message = "there is no such file, and no built-in scenario of this name"
        raise InputError(f"{safe_excerpt(scenario_name)}: {message}; did you mean {', '.join(near)}?")
    return Path(str(files(__name__) / f"{scenario_name}.toml"))


def builtin_text(scenario_name: str) -> str:
    """Text of the file of a built-in scenario, with comments, as a template; raises InputError."""
    return builtin_path(scenario_name).read_text(encoding="utf-8")
