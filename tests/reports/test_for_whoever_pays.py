"""The head of a report, what to do next, a demonstration that says so, a dark screen, a short print."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from ltsim.core.errors import RecordError
from ltsim.recordings import read, write
from ltsim.recordings.setup import Instrument, ReportHeader
from ltsim.reports.document_model import CodeBlock, Document, Section, TableBlock
from ltsim.reports.page import document_of_folder, page_html
from tests.reports import samples

ABOUT = ReportHeader(instrument="Model 9, 751234", date="2026-05-31", operator="A. Muster", customer="Hall <3>")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    top = tmp_path_factory.mktemp("paid")
    target = samples.diagnosis_folder(top)
    made = samples.recording()
    shutil.rmtree(top / "recording")
    write(made.replace(setup=made.setup.model_copy(update={"report": ABOUT})), top / "recording")
    return target


def test_head_names_who_measured_what_for_whom(folder: Path) -> None:
    content = document_of_folder(folder)
    assert dict(content.header_lines) == ABOUT.model_dump()
    assert read(folder.parent / "recording").setup.report == ABOUT
    html = page_html(content)
    assert "Hall &lt;3&gt;" in html
    assert html.index("Model 9, 751234") < html.index(content.headline) < html.index("What to do next")
    assert content.next_actions[0].startswith("Let the tripod of S3 settle")  # no alternative is worth a measurement


def test_instruments_head_a_report_where_nobody_says_which(folder: Path, tmp_path: Path) -> None:
    """Without a word in [report] the head has each tracker with its serial number; an unknown line is omitted."""
    place = shutil.copytree(folder, tmp_path / "diagnosis")
    made = samples.recording()
    trackers = {"A": Instrument(model="AT960", serial="751234"), "B": Instrument(serial="9")}
    write(made.replace(setup=made.setup.model_copy(update={"instruments": trackers})), tmp_path / "recording")
    assert dict(document_of_folder(place).header_lines)["instrument"] == "A, AT960, 751234; B, 9"
    assert dict(document_of_folder(place, about=ReportHeader(instrument="C")).header_lines)["instrument"] == "C"


def test_results_of_the_same_recording_share_it(tmp_path: Path) -> None:
    """A calibration beside another that carries the recording: the workshop is drawn once."""
    made = samples.recording()
    for verb in ("calibrate", "diagnose"):
        samples.calibration_folder(tmp_path / verb)
        shutil.copytree(tmp_path / verb / "calibration", tmp_path / verb, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "calibrate" / "recording")
    assert set(read(tmp_path / "diagnose" / "recording").targets) == set(made.targets)
    sections = {s.folder: s for s in document_of_folder(tmp_path).sections if s.kind.startswith("Calibration")}
    assert "Floor plan" in {block.title for block in sections["calibrate"].blocks}
    assert "Floor plan" not in {block.title for block in sections["diagnose"].blocks}


def test_an_option_stands_before_the_file(folder: Path) -> None:
    content = document_of_folder(folder, title="Hall 3, May", about=ReportHeader(operator="B. Person"))
    assert content.title == "Hall 3, May"
    assert dict(content.header_lines) == ABOUT.model_dump() | {"operator": "B. Person"}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('date = "31.5.2026"', "report.date .* it should be a date such as 2026-05-31"),
        ('operater = "A"', "unknown key report.operater; did you mean operator"),
        ('customer = "A\\nB"', "report.customer .* one line of printable text"),
        ("report = 5", "report"),
    ],
)
def test_a_wrong_head_gets_a_sentence(line: str, words: str, folder: Path, tmp_path: Path) -> None:
    place = shutil.copytree(folder.parent / "recording", tmp_path / "recording")
    text = (place / "setup.toml").read_text()
    begin, end = text.index("[report]"), text.index("[instrument]")
    table = line if line.startswith("report") else f"[report]\n{line}"
    head, rest = text[:begin], text[end:]
    (place / "setup.toml").write_text(f"{head}{table}\n\n{rest}")
    with pytest.raises(RecordError, match=words):
        read(place)


def test_injected_and_reported_values_are_listed_for_every_constant(tmp_path: Path) -> None:
    """The hall in 3D, both curves, and each hidden value; the time constant was a dash."""
    place = samples.diagnosis_folder(tmp_path)
    truth = {
        "format": "ltsim-truth/1", "construction": "misalignment",
        "stations": [{"name": "S3", "position_mm": [0, 0, 0], "rotation_quaternion": [0, 0, 0, 1]}],
        "targets": [{"name": "T1", "position_mm": [1, 2, 3]}],
        "effects": [{
            "effect": "station-settling", "stations": ["S3"], "targets": [], "shape": {"time_constant": 9.0},
            "parameters": [{"name": n, "value": v, "unit": "urad"} for n, v in (("tilt-x", 25.0), ("tilt-y", -18.0))],
        }],
    }  # fmt: skip
    (place / "truth.json").write_text(json.dumps(truth))
    content = document_of_folder(place)
    assert content.simulation_notice.startswith("This recording is simulated, with settling of a station (S3) injected")
    html = page_html(content)
    assert html.index(content.simulation_notice) < html.index('<div class="answer')
    scene, curves, table = content.sections[0].blocks[:3]
    assert [scene.kind, curves.kind, table.kind] == ["scene", "picture", "table"]
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["effect"] == ["settling of a station"] * 2
    assert rows["where"] == ["S3", "S3"]
    assert rows["tilt x [urad]"] == ["25.0", "12.1 +- 1.8"]
    assert rows["time constant [min]"][0] == "9.00"


def test_print_leaves_settings_and_endless_tables_out() -> None:
    long = TableBlock("Long", ["a"], [[str(i)] for i in range(500)])
    section = Section("t", "Campaign", "x", blocks=[long, CodeBlock("Settings", "{}")])
    html = page_html(Document("t", "x", "plain", [section]))
    assert '<details class="endless">' in html
    assert ".listing, .endless { display: none; }" in html


def test_many_balls_are_light() -> None:
    import numpy as np

    from ltsim.reports import scene3d

    few, many = (scene3d.ellipsoid_mesh(np.zeros((k, 3)), np.broadcast_to(np.eye(3), (k, 3, 3))) for k in (10, 1000))
    assert few.n_points / 10 > 4 * many.n_points / 1000
    assert np.abs(np.linalg.norm(many.points, axis=1) - 1.0).max() < 1e-6
