"""Diagnose a list of recordings, as `ltsim diagnose REC --out DIR --quiet` does; knows of nothing but the folders.

Run as a process of its own: `python concealed/examine.py RECORDINGS DIAGNOSES NAME...`.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import time
from pathlib import Path

from ltsim.cli.main import run

STATUS = "status.json"


def examine(recording: Path, out: Path) -> None:
    """Diagnose one recording; beside the diagnosis a note of exit status, complaint and time."""
    if (out / STATUS).exists():
        return
    start, complaint = time.perf_counter(), io.StringIO()
    with contextlib.redirect_stderr(complaint):
        try:
            status = run(["diagnose", str(recording), "--out", str(out), "--quiet"])
        except Exception as problem:
            status, _ = 3, complaint.write(f"{type(problem).__name__}: {problem}")
    words = complaint.getvalue().replace(str(recording), recording.name)[-2000:]
    note = {"exit": status, "complaint": words, "seconds": time.perf_counter() - start}
    out.mkdir(parents=True, exist_ok=True)
    (out / STATUS).write_text(json.dumps(note) + "\n", encoding="utf-8")


if __name__ == "__main__":
    folder, diagnoses, *names = sys.argv[1:]
    for name in names:
        examine(Path(folder) / name, Path(diagnoses) / name)
