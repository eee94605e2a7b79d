"""One model a result file: what is written is what the models say, and wrong files get one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.calibration.arrays import residuals_table, targets_table
from ltsim.calibration.files import read_targets
from ltsim.core.errors import LtsimError, RecordError
from ltsim.recordings import write
from ltsim.recordings.result_file import read_result, recording_digest
from ltsim.recordings.setup import Setup
from ltsim.reports.residuals import Residuals
from ltsim.reports.schemas import RESULT_MODELS, companion_table_descriptions, json_schemas, write_schemas
from ltsim.reports.verbs import report
from tests.reports import samples

FOLDERS = {
    "calibration.json": samples.calibration_folder,
    "history.json": samples.history_folder,
    "next.json": samples.next_folder,
    "diagnosis.json": samples.diagnosis_folder,
    "plan.json": samples.plan_folder,
    "manifest.json": samples.campaign_folder,
}


@pytest.mark.parametrize("model", RESULT_MODELS, ids=lambda model: model.FILE)
def test_every_format_is_listed_once_and_has_a_schema(model: Any) -> None:
    schema = json_schemas()[model.FILE]
    assert schema["properties"]["format"]["const"] == model.model_fields["format"].default
    assert f"`{model.FILE}`" in schema["description"].partition("\n\n")[0]


@pytest.mark.parametrize("name", FOLDERS)
def test_a_file_holds_nothing_that_its_model_does_not_say(name: str, tmp_path: Path) -> None:
    FOLDERS[name](tmp_path / "made")
    (file,) = (tmp_path / "made").rglob(name)
    model = next(m for m in RESULT_MODELS if name == m.FILE)
    written = json.loads(file.read_text())
    assert read_result(file, model).content() == written
    assert read_result(file.parent, model) == read_result(file, model)


def test_schemas_are_written_for_the_documentation(tmp_path: Path) -> None:
    write_schemas(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {f"{name}.schema.json" for name in json_schemas()} | {"tables.json"}
    listed = json.loads((tmp_path / "tables.json").read_text())
    assert listed == companion_table_descriptions()
    assert all(column["about"] for files in listed.values() for table in files for column in table["columns"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c["covariance"][2].pop(), "the covariance is not a matrix of 16 x 16 numbers"),
        (lambda c: c["covariance"][2].__setitem__(1, float("inf")), "the number Infinity, expected a finite"),
        (lambda c: c["fit"].update(chi2=float("nan")), "the number NaN, expected a finite"),
        (lambda c: c["stations"][0].update(position_mm=[1.0, 2.0]), "stations.0.position_mm"),
        (lambda c: c["outliers"].append({"row": 1}), "outliers.0.station: Field required"),
    ],
)
def test_a_damaged_calibration_is_refused_in_a_sentence(change: Any, words: str, tmp_path: Path) -> None:
    file = samples.calibration_folder(tmp_path) / "calibration.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    with pytest.raises(RecordError, match=words):
        report(file.parent)
    assert not (file.parent / "report.html").exists()


@pytest.mark.parametrize("name", ["history.json", "manifest.json"])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1e999", "the number 1e999"),
        ("Infinity", "the number Infinity"),
        ("[]", "change_since_first|cells"),
        ("7", "cells|sin"),
    ],
)
def test_other_damaged_files_are_refused_in_a_sentence(name: str, text: str, words: str, tmp_path: Path) -> None:
    FOLDERS[name](tmp_path / "made")
    file = tmp_path / "made" / name
    content = json.loads(file.read_text())
    key = "change_since_first" if name == "history.json" else "cells"
    whole = json.dumps(content)
    file.write_text(whole.replace(json.dumps(content[key]), text))
    with pytest.raises(LtsimError, match=words) as caught:
        report(file.parent)
    assert "\n" not in str(caught.value)


ACCEPT: dict[str, Any] = {
    "format": "ltsim-accept/1",
    "error_origin": "measured",
    "plan_name": "plan.csv",
    "specification": {
        "transverse_limit_um": 1,
        "transverse_limit_um_per_m": 1,
        "range_limit_um": 1,
        "range_limit_um_per_m": 1,
    },
    "pass_probability": 1,
    "sentence": "all errors are within their limits",
    "groups": [{"name": "bar", "n_tests": 1, "pass_probability": 1, "largest_limit_ratio": 0.5}],
    "tests": [{"name": "bar", "group": "bar", "limit_um": 10, "error_um": 5, "pass_probability": 1}],
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: None, ""),
        (lambda c: c["tests"][0].update(limit_um=0), r"tests\.0\.limit_um: Input should be greater than 0"),
        (lambda c: c.update(tests=[]), "tests: Tuple should have at least 1 item"),
        (lambda c: c.update(groups=[]), "groups: Tuple should have at least 1 item"),
        (
            lambda c: c["specification"].update(range_limit_um=0, range_limit_um_per_m=0),
            "range_limit_um and range_limit_um_per_m should not both be 0",
        ),
    ],
)
def test_figures_that_others_are_divided_by_are_not_0(change: Any, words: str, tmp_path: Path) -> None:
    content = json.loads(json.dumps(ACCEPT))
    change(content)
    (tmp_path / "accept.json").write_text(json.dumps(content))
    if not words:
        report(tmp_path)
        return
    with pytest.raises(RecordError, match=words):
        report(tmp_path)


def test_a_scenario_of_a_campaign_has_a_tracker(tmp_path: Path) -> None:
    file = samples.campaign_folder(tmp_path / "made") / "manifest.json"
    content = json.loads(file.read_text())
    content["scenarios"] = [{"instrument": {}}]
    file.write_text(json.dumps(content))
    with pytest.raises(LtsimError, match=r"scenarios\.0\.instrument\.preset: Field required"):
        report(file.parent)


def test_ragged_history_is_refused_in_a_sentence(tmp_path: Path) -> None:
    file = samples.history_folder(tmp_path / "made") / "history.json"
    content = json.loads(file.read_text())
    content["parameters"][3]["values"].pop()
    file.write_text(json.dumps(content))
    with pytest.raises(RecordError, match="needs one value and one sigma per calibration"):
        report(file.parent)


def test_tables_of_another_run_are_refused(tmp_path: Path) -> None:
    """As after a kill between two renames: the table is of the new run, the JSON of the old one."""
    folder = samples.calibration_folder(tmp_path)
    (folder / "residuals.csv").write_text(residuals_table(samples.before()).csv_text())
    with pytest.raises(RecordError, match=r"residuals\.csv: the file does not belong to calibration\.json in"):
        report(folder)
    assert not (folder / "report.html").exists()


def test_another_recording_is_refused(tmp_path: Path) -> None:
    folder = samples.calibration_folder(tmp_path)
    made = samples.recording()
    moved = made.with_readings(made.readings + [[1e-5, 0.0, 0.0]])
    write(moved, tmp_path / "other")
    with pytest.raises(RecordError, match=f"the result of another recording .*{len(made)} pointings"):
        report(folder, recording=tmp_path / "other")


def test_a_recording_keeps_its_digest_through_a_file(tmp_path: Path) -> None:
    from ltsim.recordings import read

    made = samples.recording()
    write(made, tmp_path / "copy")
    assert recording_digest(read(tmp_path / "copy")) == recording_digest(made)
    nudged = made.readings * (1 + 3e-16)
    assert recording_digest(made.with_readings(nudged)) == recording_digest(made)
    swapped = made.select(np.arange(len(made))[::-1])
    assert recording_digest(swapped) != recording_digest(made)


NAMES = ("=1+1", "+7", "-T1", "@x", "'=quoted", "a,b", 'say "x"', "plain")


def test_names_that_a_spreadsheet_would_compute_are_text_and_come_back(tmp_path: Path) -> None:
    points = np.arange(24.0).reshape(8, 3)
    text = targets_table(NAMES, points, np.tile(1e-10 * np.eye(3), (8, 1, 1))).csv_text()
    assert [line[0] for line in text.splitlines()[1:6]] == ["'"] * 5
    (tmp_path / "targets.csv").write_text(text)
    names, targets, _ = read_targets(tmp_path / "targets.csv")
    assert names == NAMES
    assert np.allclose(targets, points)


def test_residuals_of_such_names_come_back(tmp_path: Path) -> None:
    made = samples.recording()
    names = (*NAMES, *made.targets[len(NAMES) :])
    (tmp_path / "residuals.csv").write_text(
        residuals_table(adjust(made.replace(targets=names, setup=Setup()))).csv_text()
    )
    residuals = Residuals.read(tmp_path / "residuals.csv")
    assert set(residuals.target_names.tolist()) == set(names)
