"""Every experiment runs in a reduced form, writes what its README speaks of, and says what a few trials can say."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.__main__ import FOLDERS, main
from experiments.common import ERROR
from ltsim.campaigns.spec import load_campaign

Run = Callable[..., Path]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Run an experiment with a few trials; gives the folder of its results."""

    def start(name: str, trials: int, *more: str) -> Path:
        main([name[:2], "--trials", str(trials), "--out", str(tmp_path / name), *more])
        manifest = json.loads((tmp_path / name / "manifest.json").read_text())
        assert manifest["trials"] == trials
        assert manifest["command"] == f"python -m experiments {name[:2]} --trials {trials}"
        assert {"python", "ltsim", "numpy"} <= set(manifest["versions"])
        assert any(f.read_text().rstrip().endswith("</svg>") for f in (tmp_path / name).glob("*.svg"))
        return tmp_path / name

    return start


def test_the_driver_lists_every_experiment(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    listed = {line[:2]: line for line in capsys.readouterr().out.splitlines()}
    assert list(listed) == sorted(f.name[:2] for f in (root / "experiments").glob("[0-9]*"))
    assert all(len(line) > 20 for line in listed.values())
    for file in (root / "experiments").glob("[0-9]*/**/*.toml"):
        folder = next(part for part in file.parents if part.parent.name == "experiments")
        assert file.relative_to(root / "experiments").as_posix() in listed[folder.name[:2]]


@pytest.mark.parametrize("words", [["99"], ["04", "nothing"], ["20", "nothing"]])
def test_names_that_do_not_exist_are_refused(
    words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main([*words, "--out", str(tmp_path)])
    message = str(exit_info.value) + capsys.readouterr().err
    assert "choose from" in message or "does not contain" in message
    assert not list(tmp_path.iterdir())


def table(file: Path, **wanted: str) -> list[dict[str, str]]:
    """The rows of a table that have the wanted values."""
    with file.open(encoding="utf-8", newline="") as text:
        return [row for row in csv.DictReader(text) if all(row[key] == value for key, value in wanted.items())]


def only_row(file: Path, **wanted: str) -> dict[str, str]:
    """The only row with the wanted values."""
    rows = table(file, **wanted)
    assert len(rows) == 1
    return rows[0]


def mean(folder: Path, column: str, **wanted: str) -> float:
    """A mean of the summary of a campaign."""
    return float(only_row(folder / "summary.csv", column=column, **wanted)["mean"])


@pytest.mark.long
def test_the_papers_tables(run: Run) -> None:
    out = run("01_paper_tables", 3)
    after = {"figure": "distance_after_mean", "method": "eq. 9"}
    specified = only_row(out / "table_3.csv", cell="as specified", **after)
    scattered = only_row(out / "table_3.csv", cell="scatter 2.8 x, errors 0.7 x", **after)
    assert float(specified["mean"]) < 10 < 15 < float(scattered["mean"]) < 20
    assert len(table(out / "table_4.csv", figure="distance_improvement_percent", method="eq. 9")) == 6
    assert {f.name for f in out.glob("*.svg")} == {"table_3.svg", "table_4.svg"}


@pytest.mark.long
def test_the_network_is_nearer_to_the_truth(run: Run) -> None:
    out = run("02_network_against_distance", 4)
    errors = {
        method: mean(out / "config", ERROR, title="as specified", prior_factor="1000", method=method)
        for method in ("eq. 9", "distance", "network", "as applied")
    }
    assert errors["as applied"] < errors["network"] < errors["distance"] == pytest.approx(errors["eq. 9"], rel=1e-3)
    pairs = table(out / "paired.csv", title="as specified", prior_factor="1.0")
    assert {row["first"] for row in pairs} == {"eq. 9", "distance", "as applied"}
    assert list((out / "config" / "rows").rglob("*.parquet"))


@pytest.mark.long
def test_removing_outliers_beats_bearing_them(run: Run) -> None:
    out = run("03_least_squares_or_absolute", 1)
    errors = {row["method"]: float(row["new_point_mean"]) for row in table(out / "methods.csv", outliers_percent="2.0")}
    assert errors["network, outliers removed"] < min(errors["network"], errors["distance, squares"])
    clean = table(out / "methods.csv", outliers_percent="0.0")
    assert max(float(row["new_point_mean"]) for row in clean) < 40


@pytest.mark.long
def test_harmonics_that_are_there_must_be_fitted(run: Run) -> None:
    out = run("05_gauge_and_harmonics", 4)
    beyond = {"beyond_second_urad": "5"}
    errors = [mean(out / "harmonics", ERROR, method=f"order {k}", **beyond) for k in (4, 3, 2)]
    assert errors == sorted(errors)
    loose = {"range_scale_ppm": "10", "method": "network"}
    assert mean(out / "gauge", ERROR, title="4 in 2.4 m", **loose) < mean(
        out / "gauge", ERROR, title="no gauge", **loose
    )


@pytest.mark.long
def test_sensitive_positions(run: Run) -> None:
    out = run("06_sensitive_positions", 4)
    tilt = {
        row["elevation_deg"]: float(row["shift_um"]) for row in table(out / "sensitivity.csv", error="transit-tilt")
    }
    assert tilt["0"] < 1e-6 < tilt["30"] < tilt["60"]
    assert len(table(out / "more_than_the_paper.csv", method="network")) == 7


def test_the_bench_gives_the_table_back(run: Run) -> None:
    out = run("07_smr_bench_test", 20)
    row = only_row(out / "bench.csv", reflector="the paper's size", probe="full turn", eccentricity_um="26.0")
    assert float(row["rms_corrected_um"]) < 0.3 < 4 < float(row["rms_uncorrected_um"])
    arc = only_row(out / "bench.csv", reflector="the paper's size", probe="+-30 deg only", eccentricity_um="26.0")
    assert float(arc["rms_corrected_um"]) > float(row["rms_corrected_um"])


@pytest.mark.long
def test_a_wrong_prior_does_no_harm(run: Run) -> None:
    out = run("23_wrong_priors", 2)
    rows = table(out / "ratios.csv", errors="1.0", noise="1.0", method="applied")
    assert [row["declared_prior"] for row in rows] == ["0.1", "1.0", "10.0", "1000.0"]
    assert all(float(row["ratio"]) < 0.6 for row in rows)


@pytest.mark.long
def test_intervals_hold(run: Run) -> None:
    out = run("24_intervals_hold", 6)
    rows = table(out / "intervals.csv")
    assert [row["parameters"] for row in rows[-3:]] == ["126", "252", "378"]
    assert all(88 < float(row["inside"]) < 100 for row in rows)
    assert all(float(row["difference_from_full_solver_sigma"]) < 1e-3 for row in rows)


@pytest.mark.long
def test_more_noise_more_error(run: Run) -> None:
    out = run("08_noise_smr_faces", 4)
    place = {"title": "re-aimed, no SMR error", "faces": "1", "method": "network"}
    errors = [mean(out / "config", ERROR, noise_factor=k, **place) for k in ("0.5", "1", "2", "4")]
    assert errors == sorted(errors)


@pytest.mark.long
def test_an_instrument_that_changed_is_calibrated_less_well(run: Run) -> None:
    out = run("09_temperature", 4)
    right = {"gauge_scale_ppm": "0", "method": "network"}
    shares = [mean(out / f"drift-{k}", "new_point_share_removed", **right) for k in ("0", "0.5", "1")]
    assert shares == sorted(shares, reverse=True)
    printed = mean(out / "drift-0", ERROR, method="eq. 9", gauge_scale_ppm="162.4")
    assert printed > 200
    assert ">eq. 9" in (out / "new_points.svg").read_text()


@pytest.mark.parametrize("number", ["02", "05", "06", "08", "09", "23", "24", "26"])
def test_each_is_a_campaign_file_that_any_command_runs(number: str) -> None:
    for file in FOLDERS[number].glob("*.toml"):
        campaign, scenarios = load_campaign(file)
        assert scenarios and len({method.title for method in campaign.methods}) == len(campaign.methods)
        assert number in ("24", "26") or campaign.validation_points
