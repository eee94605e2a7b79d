"""No module of ltsim imports what one operating system alone has."""

from __future__ import annotations

import ast
from pathlib import Path

import ltsim

UNIX = {"curses", "fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
WINDOWS = {"msvcrt", "winreg", "winsound", "nt"}


def imported(path: Path) -> set[str]:
    """First names of all modules that a file imports, wherever it does."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return {name.partition(".")[0] for name in plain | {n.module or "" for n in nodes if isinstance(n, ast.ImportFrom)}}


def test_every_import_is_there_on_every_system() -> None:
    package = Path(ltsim.__file__).parent
    imports_by_module = {
        str(path.relative_to(package)): imported(path) & (UNIX | WINDOWS) for path in package.rglob("*.py")
    }
    assert len(imports_by_module) > 100 and "pyarrow" in imported(package / "campaigns" / "store.py")
    guarded = {"scene/cad_process.py": {"resource"}}  # `limit_process_resources` does without it where there is none
    assert {path: names for path, names in imports_by_module.items() if names - guarded.get(path, set())} == {}
