"""What users of real data ask of `adjust` and `calibrate`: robust, noise from the readings, a datum, points."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.cli.main import run
from ltsim.recordings import read, write
from tests.families import family
from tests.networks import network


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A recording with one wrong range and one wrong azimuth."""
    recording, _ = network(faces=2, seed=6)
    readings = recording.readings.copy()
    readings[20, 0] += 200e-6
    readings[150, 1] += 60e-6
    folder = tmp_path_factory.mktemp("work") / "rec"
    write(recording.with_readings(readings), folder)
    return folder


def test_robust_and_noise_are_printed_and_written(source: Path, tmp_path: Path, capsys) -> None:
    assert run(["calibrate", str(source), "--robust", "--noise-from-data", "--out", str(tmp_path / "cal")]) == 0
    text = capsys.readouterr().out
    assert "the noise was estimated from the same readings, so the global test does not apply" in text
    assert "2 readings did not fit and were left out" in text
    assert "Noise estimated from the readings" in text
    rows = [line.split() for line in text.splitlines()]
    assert [row[0] for row in rows if "yes" in row] == ["21", "151"]  # left out
    content = json.loads((tmp_path / "cal" / "calibration.json").read_text())
    assert {(o["row"], o["observable"], o["excluded"]) for o in content["outliers"]} == {
        (21, "distance", True),
        (151, "azimuth", True),
    }
    assert [n["observable"] for n in content["noise"]] == ["distance", "azimuth", "elevation"]


def test_without_the_options_the_summary_says_which_test_to_trust(source: Path, capsys) -> None:
    assert run(["calibrate", str(source)]) == 0
    text = capsys.readouterr().out
    assert "Trust the " in text
    assert "or reject with --robust" in text


@pytest.mark.parametrize("verb", family(["adjust", "calibrate"]))
def test_a_datum_is_chosen_by_names(verb: str, source: Path, tmp_path: Path) -> None:
    names = ["T01", "T08", "T20", "T23"]
    assert run([verb, str(source), "--datum", ",".join(names), "--out", str(tmp_path / "free"), "-q"]) == 0
    assert run([verb, str(source), "--out", str(tmp_path / "first"), "-q"]) == 0
    content = json.loads((tmp_path / "free" / "calibration.json").read_text())
    assert "inner constraints over T01, T08, T20, T23" in content["frame"]
    trace = {}
    for folder in ("free", "first"):
        rows = list(csv.DictReader((tmp_path / folder / "targets.csv").read_text().splitlines()))
        sigmas = [float(r[f"sigma_{a}_mm"]) ** 2 for r in rows if r["target"] in names for a in "xyz"]
        trace[folder] = sum(sigmas)
    assert trace["free"] < 0.7 * trace["first"]
    if verb == "adjust":
        wanted = adjust(read(source), datum_names=names).target_covariances
        chosen = [read(source).targets.index(name) for name in names]
        assert trace["free"] == pytest.approx(1e6 * np.einsum("tii->", wanted[chosen]), rel=1e-2)


def test_a_simulated_recording_comes_out_in_the_axes_of_its_scenario(tmp_path: Path, capsys) -> None:
    """By default as near as tripods are put to their marks, with --frame as near as nests to the drawing."""
    rec, truth, plan = tmp_path / "rec", tmp_path / "truth.json", tmp_path / "hall.toml"
    assert run(["simulate", "paper-workshop", "--show"]) == 0
    plan.write_text(capsys.readouterr().out)
    assert run(["simulate", str(plan), "--out", str(rec), "--truth", str(truth), "-q"]) == 0
    true = {t["name"]: t["position_mm"] for t in json.loads(truth.read_text())["targets"]}
    for frame, gap_mm in ("", 100.0), (str(plan), 20.0), ("paper-workshop", 20.0):
        options = ["--frame", frame] if frame else []
        out = tmp_path / f"adjusted-{Path(frame).stem}"
        assert run(["adjust", str(rec), *options, "--out", str(out), "-q"]) == 0
        rows = csv.DictReader((out / "targets.csv").read_text().splitlines())
        gaps = [np.subtract([float(row[f"{axis}_mm"]) for axis in "xyz"], true[row["target"]]) for row in rows]
        assert len(gaps) == len(true)
        assert np.abs(gaps).max() < gap_mm


def test_a_corrected_recording_keeps_the_axes_it_was_given(source: Path, tmp_path: Path) -> None:
    """Readings are those without --frame; what is computed from them comes out in its axes."""
    cal, frame, plain, framed = (str(tmp_path / name) for name in ("cal", "three.toml", "plain", "framed"))
    assert run(["calibrate", str(source), "--out", cal, "-q"]) == 0
    Path(frame).write_text('origin = "T01"\nx_axis = "T04"\nxy_plane = "T20"\n')
    correct = ["correct", str(source), "--calibration", cal, "-q", "--out"]
    assert run([*correct, plain]) == run([*correct, framed, "--frame", frame]) == 0
    np.testing.assert_array_equal(read(framed).readings, read(plain).readings)
    assert run(["adjust", framed, "--out", str(tmp_path / "net"), "-q"]) == 0
    rows = {r["target"]: r for r in csv.DictReader((tmp_path / "net" / "targets.csv").read_text().splitlines())}
    a, b, c = (rows[name] for name in ("T01", "T04", "T20"))
    zero = [a["x_mm"], a["y_mm"], a["z_mm"], b["y_mm"], b["z_mm"], c["z_mm"]]
    np.testing.assert_allclose([float(v) for v in zero], 0.0, atol=1e-6)


def test_a_calibration_that_lacks_parameters_is_used_with_a_note(source: Path, tmp_path: Path, capsys) -> None:
    hand = tmp_path / "hand.json"
    rows = [{"name": "beam-tilt", "value": 5.9, "unit": "urad"}]
    hand.write_text(json.dumps({"format": "ltsim-calibration/1", "construction": "misalignment", "parameters": rows}))
    for command in (["correct", str(source), "--out", str(tmp_path / "rec2")], ["evaluate", str(source)]):
        assert run([*command, "--calibration", str(hand)]) == 0
        assert "15 parameters are not in the file and taken as zero" in capsys.readouterr().err


@pytest.mark.long
def test_a_requested_effect_is_on_the_page_and_reported_to_stay_in_the_readings(
    source: Path, tmp_path: Path, capsys
) -> None:
    fitted = tmp_path / "cal"
    assert run(["calibrate", str(source), "--with", "air-layer", "--out", str(fitted), "-q"]) == 0
    assert run(["report", str(fitted), "-q"]) == 0
    name = json.loads((fitted / "calibration.json").read_text())["effects"][0]["effect"]
    page = (fitted / "report.html").read_text(encoding="utf-8")
    assert "Effects estimated with the calibration" in page
    assert f"{name}: " in page
    capsys.readouterr()
    assert run(["correct", str(source), "--calibration", str(fitted), "--out", str(tmp_path / "rec3")]) == 0
    assert "stay in the readings: layered air" in capsys.readouterr().err


def test_a_history_of_recordings_treats_all_recordings_equally(source: Path, tmp_path: Path, capsys) -> None:
    recording, _ = network(faces=2, seed=9)
    noise = recording.reading_sigmas() * np.random.default_rng(3).standard_normal(recording.readings.shape)
    write(recording.with_readings(recording.readings + 2 * noise), tmp_path / "noisy")
    names = [str(source), str(tmp_path / "noisy")]
    fits = {}
    for options in ([], ["--robust", "--noise-from-data"]):
        assert run(["history", *names, *options, "--json"]) == 0
        content = json.loads(capsys.readouterr().out)
        fits[bool(options)] = [c["fit"]["sigma0"] for c in content["calibrations"]]
    assert fits[False][1] > 2.0
    assert fits[True] == pytest.approx([1.0, 1.0], abs=0.05)
