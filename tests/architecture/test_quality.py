"""Lint, types and layers are tests like any other."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

SCRIPTS = Path(sysconfig.get_path("scripts"))

CHECKS = {
    "lint": [sys.executable, "-m", "ruff", "check", "--output-format", "concise", "."],
    "format": [sys.executable, "-m", "ruff", "format", "--check", "-q", "."],
    "types": [sys.executable, "-m", "mypy", "--no-pretty"],
    "layers": [str(SCRIPTS / "lint-imports")],
}


@pytest.mark.parametrize("check", CHECKS)
def test_quality(check: str, root: Path) -> None:
    done = subprocess.run(CHECKS[check], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{check}:\n{done.stdout}\n{done.stderr}"
