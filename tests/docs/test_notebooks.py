"""Notebooks among the examples: their outputs are those that a new kernel gives in the folder of the examples."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from ltsim.cli.examples import COMMAND_BY_EXAMPLE_FILE, example_file_content
from ltsim.cli.main import run

NOTEBOOKS = [name for name in COMMAND_BY_EXAMPLE_FILE if name.endswith(".ipynb")]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
SHOWN = 0.02
"""Relative difference of printed numbers: their last digits depend on the processor."""


def printed(cells: list[Any]) -> list[str]:
    """Texts that the cells print and show."""
    outputs = [output for cell in cells if cell["cell_type"] == "code" for output in cell["outputs"]]
    texts = ["".join(output.get("text") or output["data"]["text/plain"]) for output in outputs]
    pictures = sum("image/png" in output.get("data", {}) for output in outputs)
    return [*texts, f"{pictures} pictures"]


def test_there_are_three_notebooks_with_their_outputs() -> None:
    nbformat = pytest.importorskip("nbformat", reason="notebooks are read by nbformat")
    assert len(NOTEBOOKS) == 3
    for name in NOTEBOOKS:
        book = nbformat.reads(example_file_content(name), 4)
        nbformat.validate(book)
        code = [cell for cell in book.cells if cell.cell_type == "code"]
        assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
        assert not [o for cell in code for o in cell.outputs if o.output_type == "error"]


@pytest.mark.long
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_prints_its_outputs_again(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbformat = pytest.importorskip("nbformat", reason="notebooks are read by nbformat")
    client = pytest.importorskip("nbclient", reason="notebooks are executed by nbclient")
    for package in ("ipykernel", "pandas", "xarray", "duckdb"):
        pytest.importorskip(package, reason=f"the notebooks need {package}")
    monkeypatch.delenv("MPLBACKEND", raising=False)
    assert run(["examples", str(tmp_path), "--quiet"]) == 0
    stored = nbformat.read(tmp_path / name, 4)
    again = nbformat.read(tmp_path / name, 4)
    client.NotebookClient(again, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    for before, now in zip(printed(stored.cells), printed(again.cells), strict=True):
        assert NUMBER.sub("#", now).split() == NUMBER.sub("#", before).split()
        numbers = [[float(text) for text in NUMBER.findall(shown)] for shown in (now, before)]
        assert numbers[0] == pytest.approx(numbers[1], rel=SHOWN, abs=0.02)
