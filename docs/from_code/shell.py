"""Small shell for the commands in the documentation; it calls `ltsim` as a function, which saves seconds per command.

For `ltsim` commands it interprets ``&&``, a backslash at the end of a line, ``> FILE``, and the comment ``# exit status
N`` for an expected status other than 0. All other commands are run by bash.
"""

import contextlib
import io
import re
import shlex
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path

from ltsim.cli.main import run

STATUS = re.compile(r"#\s*exit status (\d+)\s*$")
HERE = re.compile(r"<<'(\w+)'\s*$")


@dataclass(frozen=True)
class Outcome:
    """Standard output and standard error of a command; `right` is True if its exit status is as expected."""

    printed: str
    said: str
    right: bool


def commands(text: str) -> list[str]:
    """Commands of a code block, each with the lines of its here-document, if there is one."""
    found: list[str] = []
    waiting = text.replace("\\\n", " ").splitlines()
    while waiting:
        line = waiting.pop(0)
        here = HERE.search(line)
        if here is not None:
            end = waiting.index(here[1]) + 1
            found.append("\n".join([line, *waiting[:end]]))
            waiting = waiting[end:]
        else:
            found += [part.strip() for part in line.split("&&") if part.strip() and not part.strip().startswith("#")]
    return found


def execute(command: str) -> Outcome:
    """Run one command in the current folder."""
    wanted = STATUS.search(command)
    words = [] if "\n" in command else shlex.split(command, comments=True)
    if words[:1] != ["ltsim"] or {"|", "<"} & set(words):
        script = f'PATH="{sysconfig.get_path("scripts")}:$PATH"; {command}'
        done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
        printed, said, status = done.stdout, done.stderr, done.returncode
    else:
        printed, said, status = _ltsim(words[1:])
    return Outcome(printed, said, status == (int(wanted[1]) if wanted else 0))


def _ltsim(words: list[str]) -> tuple[str, str, int]:
    file = None
    if len(words) > 1 and words[-2] == ">":
        words, file = words[:-2], Path(words[-1])
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = run(words)
        sys.stdout.flush()
    if file is None:
        return out.getvalue(), err.getvalue(), status
    file.write_text(out.getvalue(), encoding="utf-8")
    return "", err.getvalue(), status
