"""Every experiment runs in a reduced form, writes what its README speaks of, and says what a few trials can say."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.__main__ import main

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
    listed = capsys.readouterr().out.splitlines()
    assert [line[:2] for line in listed] == sorted(f.name[:2] for f in (root / "experiments").glob("[0-9]*"))
    assert all(len(line) > 20 for line in listed)


@pytest.mark.parametrize("words", [["99"], ["04", "nothing"], ["20", "nothing"]])
def test_what_does_not_exist_is_said(words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as left:
        main([*words, "--out", str(tmp_path)])
    said = str(left.value) + capsys.readouterr().err
    assert "there are" in said or "choose from" in said or "no part of the project" in said
    assert not list(tmp_path.iterdir())


def table(file: Path, **wanted: str) -> list[dict[str, str]]:
    """The rows of a table that have the wanted values."""
    with file.open(encoding="utf-8", newline="") as text:
        return [row for row in csv.DictReader(text) if all(row[key] == value for key, value in wanted.items())]


def one(file: Path, **wanted: str) -> dict[str, str]:
    """The only row with the wanted values."""
    rows = table(file, **wanted)
    assert len(rows) == 1
    return rows[0]


def test_the_papers_tables(run: Run) -> None:
    out = run("01_paper_tables", 3)
    after = {"figure": "distance_after_mean", "method": "eq. 9"}
    specified = one(out / "table_3.csv", cell="as specified", **after)
    scattered = one(out / "table_3.csv", cell="scatter 2.8 x, errors 0.7 x", **after)
    assert float(specified["mean"]) < 10 < 15 < float(scattered["mean"]) < 20
    assert len(table(out / "table_4.csv", figure="distance_improvement_percent", method="eq. 9")) == 3 * 7


def test_the_network_is_nearer_to_the_truth(run: Run) -> None:
    out = run("02_network_against_distance", 8)
    cell = "scatter 2.8 x, errors 0.7 x"
    methods = ("eq. 9", "distance", "network")
    shares = [float(one(out / "share_removed.csv", cell=cell, method=m)["share"]) for m in methods]
    assert shares[0] < shares[1] < shares[2] < 1.0
    assert len(table(out / "parameters.csv")) == 3 * 16
    for norm, name in (("squares, mm^2", "eq. 9, squares"), ("absolute, mm", "eq. 9, absolute")):
        reached = table(out / "minimum.csv", cell=cell, norm=norm)
        assert {row["method"]: row["is_the_least_in"] for row in reached if row["is_the_least_in"] != "0"} == {
            name: "8"
        }
    wide = table(out / "priors.csv", cell=cell, prior="1000 x")
    errors = {row["method"]: float(row["held_out_error_mean_um"]) for row in wide}
    assert errors["network, as applied"] < errors["network"] < errors["distance"] == errors["eq. 9"]


def test_removing_outliers_beats_bearing_them(run: Run) -> None:
    out = run("03_least_squares_or_absolute", 1)
    errors = {
        row["method"]: float(row["held_out_error_mean_um"])
        for row in table(out / "methods.csv", outliers_percent="2.0")
    }
    assert errors["network, outliers removed"] < min(errors["network"], errors["distance, least squares"])
    clean = table(out / "methods.csv", outliers_percent="0.0")
    assert max(float(row["held_out_error_mean_um"]) for row in clean) < 40


def test_harmonics_that_are_there_must_be_fitted(run: Run) -> None:
    out = run("05_gauge_and_harmonics", 4)
    known = {"truth_beyond_second_urad": "5.0", "method": "network"}
    errors = [float(one(out / "harmonics.csv", fitted_order=k, **known)["held_out_error_um"]) for k in "1234"]
    assert errors[3] < errors[2] < errors[1] < errors[0]
    loose = {"cell": "range scale known to 10 ppm", "method": "network", "size": "4.0"}
    scales = [float(one(out / "gauge.csv", reflectors=n, **loose)["range_scale_rms_ppm"]) for n in "04"]
    assert scales[1] < scales[0]


def test_sensitive_positions(run: Run) -> None:
    out = run("06_sensitive_positions", 4)
    tilt = {
        row["elevation_deg"]: float(row["shift_um"])
        for row in table(out / "sensitivity.csv", error="transit-tilt", range_m="4.0")
    }
    assert tilt["0"] < 1e-6 < tilt["30"] < tilt["60"]
    assert len(table(out / "designs.csv", method="network")) == 8


def test_the_bench_gives_the_table_back(run: Run) -> None:
    out = run("07_smr_bench_test", 20)
    row = one(out / "bench.csv", reflector="the paper's size", probe="full turn", eccentricity_um="26.0")
    assert float(row["rms_corrected_um"]) < 0.3 < 4 < float(row["rms_uncorrected_um"])
    arc = one(out / "bench.csv", reflector="the paper's size", probe="+-30 deg only", eccentricity_um="26.0")
    assert float(arc["rms_corrected_um"]) > float(row["rms_corrected_um"])


def test_a_wrong_prior_does_no_harm(run: Run) -> None:
    out = run("23_wrong_priors", 2)
    rows = table(out / "priors.csv")
    assert len(rows) == 4 * 8
    for row in table(out / "priors.csv", cell="as specified"):
        assert float(row["ratio"]) < 0.6
    assert float(one(out / "priors.csv", cell="as specified", prior="1000 x")["says_prior_contradicted_percent"]) == 100


def test_intervals_hold(run: Run) -> None:
    out = run("24_intervals_hold", 6)
    rows = table(out / "intervals.csv")
    assert [row["parameters"] for row in rows[-3:]] == ["126", "252", "378"]
    assert all(88 < float(row["inside_percent"]) < 100 for row in rows)
    assert all(float(row["apart_from_full_solver_sigma"]) < 1e-3 for row in rows)


def test_more_noise_more_error(run: Run) -> None:
    out = run("08_noise_smr_faces", 4)
    cells = ("noise 0.5 x", "noise 1 x, one face, re-aimed", "noise 2 x", "noise 4 x")
    errors = [float(one(out / "cells.csv", cell=c, method="network")["held_out_error_mean_um"]) for c in cells]
    assert errors == sorted(errors)


def test_a_cold_instrument_is_calibrated_less_well(run: Run) -> None:
    out = run("09_temperature", 4)
    known = {
        "cell": "gauge right at 27 C",
        "method": "network",
        "used_in": "large room",
        "air_ppm_per_k": "0.0",
    }
    shares = [float(one(out / "rooms.csv", drift_per_k=r, **known)["share_removed"]) for r in ("0.0", "0.5", "2.0")]
    assert shares[2] < shares[1] < shares[0]
    printed = known | {"cell": "eq. 15 as printed", "drift_per_k": "0.0"}
    assert float(one(out / "rooms.csv", **printed)["share_removed"]) < shares[0]
