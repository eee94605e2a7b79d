"""Default noise of a total station is no smaller than the steps of its readings."""

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.recordings import Recording, read

ARCSEC = np.pi / 648_000
FOOT_M = 0.3048


def table(path: Path, angle_step: float, length_step: float, *, length_unit: str = "m") -> Recording:
    """Twelve targets from two set-ups, with readings rounded to steps [arcsec, m] and written with all digits."""
    rng = np.random.default_rng(3)
    targets = rng.uniform([-30, -20, 0], [30, 20, 6], (12, 3))
    rows = [f"Station;Point;Hz [deg];Zenith [deg];SD [{length_unit}]"]
    for station, place in (("A", np.array([0.5, 1.0, 1.5])), ("B", np.array([20.0, -11.0, 1.7]))):
        for i, target in enumerate(targets):
            x, y, z = target - place
            length = round(float(np.linalg.norm(target - place)) / length_step) * length_step
            angles = np.arctan2(x, y) % (2 * np.pi), np.arccos(z / np.linalg.norm(target - place))
            texts = (f"{round(a / ARCSEC / angle_step) * angle_step / 3600:.9f}" for a in angles)
            rows.append(";".join([station, f"P{i}", *texts, f"{length:.15g}"]))
    path.write_text("\n".join(rows) + "\n")
    return read(path)


@pytest.mark.parametrize(
    ("angle_step", "length_step", "distance_mm", "angle_arcsec"),
    [(1.0, 1e-3, 1.0, 1.0), (10.0, 1e-3, 1.0, 10.0), (3.24, 0.01, 10.0, 3.24), (5.0, 0.001 * FOOT_M, 1.0, 5.0)],
)
def test_noise_is_no_smaller_than_the_step_of_the_readings(
    tmp_path: Path, angle_step: float, length_step: float, distance_mm: float, angle_arcsec: float
) -> None:
    recording = table(tmp_path / "a.csv", angle_step, length_step)
    noise = recording.setup.instrument.noise
    assert noise.distance_mm == pytest.approx(distance_mm) and noise.azimuth_arcsec == pytest.approx(angle_arcsec)
    assert noise.elevation_arcsec == noise.azimuth_arcsec
    text = f"total station is used ({distance_mm:g} mm + 1.5 ppm, {angle_arcsec:g} arcsec), because the ranges"
    assert text in recording.notes[0]


def test_rounding_alone_does_not_contradict_the_model(tmp_path: Path) -> None:
    adjusted = lt.adjust(table(tmp_path / "a.csv", 10.0, 0.01))
    assert adjusted.fit.sigma0 is not None and adjusted.fit.sigma0 < 1.1


def test_lengths_converted_from_feet_are_no_laser_tracker(tmp_path: Path) -> None:
    recording = table(tmp_path / "a.csv", 1.0, 0.001 * FOOT_M)
    assert "because the ranges are written to 0.3 mm" in recording.notes[0]
    assert "default noise of a laser tracker" in table(tmp_path / "b.csv", 0.01, 1e-6).notes[0]
