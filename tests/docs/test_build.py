"""The documentation builds without a warning and holds what is generated from the code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ltsim.cli.main import COMMANDS
from ltsim.physics.effects import CATALOGUE

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def built(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("html")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", str(folder / "cache")]
    done = subprocess.run([*command, str(root / "docs"), str(folder)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_verb_has_its_section(built: Path) -> None:
    page = (built / "reference" / "command-line.html").read_text(encoding="utf-8")
    assert [verb for verb in COMMANDS if f'id="ltsim-{verb}"' not in page] == []


def test_every_effect_has_its_section(built: Path) -> None:
    page = (built / "effects.html").read_text(encoding="utf-8")
    assert [effect.name for effect in CATALOGUE if f'id="{effect.name}"' not in page] == []


def test_pages_ask_for_nothing_from_the_network(built: Path) -> None:
    """Read offline: no script, font or picture of another host."""
    for page in built.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        for attribute in ('src="http', 'src="//', 'rel="stylesheet" href="http', 'rel="stylesheet" href="//'):
            assert attribute not in text, f"{page.name}: {attribute}"
