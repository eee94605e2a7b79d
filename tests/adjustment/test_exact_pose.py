"""Standard deviations of a station that defines the frame."""

import json
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.cli.main import run
from ltsim.recordings.setup import Station


def test_a_station_that_defines_the_frame_is_exact() -> None:
    recording, _ = lt.simulate("paper-workshop", seed=3)
    covariance = adjust(recording).pose_covariance
    assert not covariance[0].any() and (np.diagonal(covariance[1:], axis1=1, axis2=2) > 0).all()


def test_levels_of_the_station_that_defines_the_frame_keep_their_variance() -> None:
    """A levelled station defines the origin and the azimuth alone."""
    recording, _ = lt.simulate("paper-workshop", seed=3)
    levelled = {"S1": Station(levelled=True, levelling_sigma_arcsec=1.0)}
    recording = recording.replace(setup=recording.setup.model_copy(update={"stations": levelled}))
    sigma = np.sqrt(np.diag(adjust(recording).pose_covariance[0]))
    assert not sigma[[0, 1, 2, 5]].any() and sigma[3:5] == pytest.approx(np.radians(1 / 3600), rel=0.01)


@pytest.mark.parametrize("command", [["adjust"], ["calibrate"], ["calibrate", "--method", "distance"]])
def test_exact_coordinates_have_no_uncertainty_in_tables(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lt.write(lt.simulate("paper-workshop", seed=3)[0], tmp_path / "rec")
    assert run([*command, str(tmp_path / "rec"), "--out", str(tmp_path / "out")]) in (0, 1)
    output = capsys.readouterr().out
    row = next(line.split() for line in output.splitlines() if line.startswith("S1 "))
    assert row[-3:] == ["-", "-", "-"]
    assert "S1 has no U in coordinates that are exact, because it defines the frame." in output
    poses = json.loads((tmp_path / "out" / "calibration.json").read_text())["stations"]
    assert poses[0]["sigma_position_mm"] == [0.0] * 3 and min(poses[1]["sigma_position_mm"]) > 1e-4
