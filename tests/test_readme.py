"""The worked example of the README runs and says what it should."""

from __future__ import annotations

import re
from pathlib import Path


def test_the_worked_example_runs(root: Path, capsys):
    text = (root / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(blocks) == 1
    exec(compile(blocks[0], "README.md", "exec"), {})
    said = capsys.readouterr().out
    assert "chi2/dof" in said
    assert "station S3" in said


def test_the_picture_and_the_links_of_the_readme_exist(root: Path):
    text = (root / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert (root / target).exists(), target
