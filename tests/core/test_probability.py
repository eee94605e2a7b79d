"""Chances are told of both sides, and none is told as nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ltsim.cli.main import run
from ltsim.core.probability import p_value_relation_text, p_value_text, two_sided_p_value


@pytest.mark.parametrize(
    ("upper", "text"),
    [
        (0.0, "p < 1e-6"),
        (1.0, "p < 1e-6"),
        (1e-7, "p < 1e-6"),
        (0.004, "p = 0.008"),
        (0.75, "p = 0.5"),
        (0.5, "p > 0.99"),
    ],
)
def test_a_chance_is_of_both_sides(upper: float, text: str) -> None:
    assert p_value_relation_text(two_sided_p_value(upper)) == text


def test_no_chance_is_a_dash() -> None:
    assert p_value_text(None) == p_value_text(two_sided_p_value(float("nan"))) == "–"


@pytest.mark.parametrize(
    ("verb", "factor", "words"),
    [
        ("adjust", 10.0, "smaller than the declared noise"),
        ("adjust", 0.1, "do not agree"),
        pytest.param("calibrate", 0.1, "do not agree", marks=pytest.mark.long),
    ],
)
def test_wrongly_declared_noise_is_no_agreement_on_either_side(
    verb: str, factor: float, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One side of the test has p_value 0 in the file, the other 1; what is printed is the same on both."""
    simulated(tmp_path / "rec", factor)
    capsys.readouterr()
    assert run([verb, str(tmp_path / "rec"), "--out", str(tmp_path / "out")]) == 0
    output = capsys.readouterr().out
    assert "two-sided p < 1e-6" in output and words in output
    assert "p = 0:" not in output and "p = 1:" not in output
    fit = json.loads((tmp_path / "out" / "calibration.json").read_text())["fit"]
    assert fit["p_value"] == pytest.approx(float(factor > 1), abs=1e-6)
    assert run(["report", str(tmp_path / "out"), "-q"]) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "&lt; 1e-6" in page and words in page


def test_a_calibration_estimates_noise_that_is_declared_too_large(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It lets no prior win over the readings, and leaves no agreement to be tested."""
    simulated(tmp_path / "rec", 5.0)
    capsys.readouterr()
    assert run(["calibrate", str(tmp_path / "rec"), "--out", str(tmp_path / "out")]) == 0
    captured = capsys.readouterr()
    assert "times as much as declared: the estimated noise replaces it" in captured.err
    assert "the global test does not apply" in captured.out and "two-sided p <" not in captured.out
    worth = json.loads((tmp_path / "out" / "calibration.json").read_text())["correction"]
    assert worth["noise_error_um"] == pytest.approx(11.5, rel=0.1)  # of the noise that the readings have


def simulated(folder: Path, factor: float) -> None:
    """A recording of the paper's workshop that states `factor` times the noise that it has."""
    assert run(["simulate", "paper-workshop", "--out", str(folder), "-q"]) == 0
    setup = folder / "setup.toml"
    lines = setup.read_text().splitlines()
    noise = ("distance_mm", "distance_ppm", "azimuth_arcsec", "elevation_arcsec")
    noise_lines = [line.partition(" = ") for line in lines if line.startswith(noise)]
    wrong = {key: f"{key} = {factor * float(value)}" for key, _, value in noise_lines}
    setup.write_text("\n".join(wrong.get(line.partition(" = ")[0], line) for line in lines) + "\n")
