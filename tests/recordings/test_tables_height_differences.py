"""Tables of horizontal distances and height differences, without vertical angles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import RecordError
from ltsim.core.units import ARCSECOND
from ltsim.recordings import Hints, Recording, read

TARGETS = {"P1": (12.0, 3.0, 1.5), "P2": (-8.0, 15.0, -0.7), "P3": (4.0, -21.0, 2.1), "P4": (-17.0, -6.0, 0.3)}
"""Coordinates [m] of targets relative to the tilting axis of both instruments."""
INSTRUMENT_HEIGHT, TARGET_HEIGHT = 1.634, 1.3


def table(columns: str, *, mark_to_mark: bool) -> str:
    """Table of all targets from two set-ups, with `columns` after the angle and the horizontal distance."""
    lines = [f"Station;Point;Hz;HD;{columns}"]
    rise = INSTRUMENT_HEIGHT - TARGET_HEIGHT if mark_to_mark else 0.0
    for station, zero in (("S1", 0.3), ("S2", 1.9)):
        for name, (x, y, z) in TARGETS.items():
            circle = np.degrees(np.arctan2(x, y) + zero) % 360.0
            heights = f";{INSTRUMENT_HEIGHT};{TARGET_HEIGHT}" if "IH" in columns else ""
            lines.append(f"{station};{name};{circle:.5f};{np.hypot(x, y):.4f};{z + rise:.4f}{heights}")
    return "\n".join(lines) + "\n"


def recorded(folder: Path, text: str) -> Recording:
    (folder / "survey.csv").write_text(text)
    return read(folder / "survey.csv", hints=Hints(angle="deg"))


@pytest.mark.parametrize(
    ("columns", "mark_to_mark"),
    [
        ("dH", False),
        ("VD", False),
        ("dH [m]", False),
        ("dH_m", False),
        ("Höhenunterschied", False),
        ("dH;IH;TH", True),
        ("VD;IH;TH", False),
    ],
)
def test_elevations_follow_from_height_differences(tmp_path: Path, columns: str, mark_to_mark: bool) -> None:
    recording = recorded(tmp_path, table(columns, mark_to_mark=mark_to_mark))
    x, y, z = np.array([TARGETS[recording.targets[i]] for i in recording.target]).T
    np.testing.assert_allclose(recording.readings[:, 2], np.arctan2(z, np.hypot(x, y)), atol=1e-5)
    (note,) = [note for note in recording.notes if "height differences" in note]
    assert "no vertical angles" in note
    assert ("between the marks" in note) == mark_to_mark
    assert not any("covariates" in note for note in recording.notes)


def test_rounded_height_differences_give_less_certain_elevations(tmp_path: Path) -> None:
    recording = recorded(tmp_path, table("dH", mark_to_mark=False))
    x, y, _ = np.array([TARGETS[recording.targets[i]] for i in recording.target]).T
    rounding = 1e-4 / np.sqrt(12.0) / np.hypot(x, y)
    np.testing.assert_allclose(recording.reading_sigmas()[:, 2], np.hypot(ARCSECOND, rounding), rtol=1e-3)


def test_measured_vertical_angles_have_priority(tmp_path: Path) -> None:
    lines = table("dH", mark_to_mark=False).splitlines()
    with_angles = [f"{lines[0]};Zenith", *(f"{line};90.0" for line in lines[1:])]
    recording = recorded(tmp_path, "\n".join(with_angles) + "\n")
    np.testing.assert_allclose(recording.readings[:, 2], 0.0, atol=1e-12)
    assert "dH" in recording.covariates


def test_a_missing_unit_of_horizontal_angles_is_not_reported_for_elevations(tmp_path: Path) -> None:
    (tmp_path / "survey.csv").write_text(table("dH", mark_to_mark=False))
    with pytest.raises(RecordError, match="may be horizontal angles in deg or horizontal angles in gon"):
        read(tmp_path / "survey.csv")


@pytest.mark.parametrize("has_faces", [True, False])
def test_raw_circle_readings_in_both_faces(tmp_path: Path, has_faces: bool) -> None:
    lines = [f"Station;Point{';Face' if has_faces else ''};Hz;HD;dH"]
    for name, (x, y, z) in TARGETS.items():
        for face in (1, 2):
            circle = (np.degrees(np.arctan2(x, y)) + 180.0 * (face == 2)) % 360.0
            lines.append(f"S1;{name}{f';{face}' if has_faces else ''};{circle:.5f};{np.hypot(x, y):.4f};{z:.4f}")
    recording = recorded(tmp_path, "\n".join(lines) + "\n")
    assert recording.face.tolist() == [1, 2] * len(TARGETS)
    assert not any("reduced to face 1" in note for note in recording.notes)
    x, y, z = np.array([TARGETS[recording.targets[i]] for i in recording.target]).T
    elevation = np.where(recording.face == 2, np.pi - recording.readings[:, 2], recording.readings[:, 2])
    np.testing.assert_allclose(elevation, np.arctan2(z, np.hypot(x, y)), atol=1e-5)


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, ""), (1.0, " m")])
def test_heights_without_unit_in_the_title(tmp_path: Path, factor: float, unit: str) -> None:
    """Heights in millimetres beside distances in metres, and heights with the unit in the cells."""
    heights = f"{factor * INSTRUMENT_HEIGHT:g}{unit};{factor * TARGET_HEIGHT:g}{unit}"
    text = table("dH;IH;TH", mark_to_mark=True).replace(f"{INSTRUMENT_HEIGHT};{TARGET_HEIGHT}", heights)
    recording = recorded(tmp_path, text)
    x, y, z = np.array([TARGETS[recording.targets[i]] for i in recording.target]).T
    np.testing.assert_allclose(recording.readings[:, 2], np.arctan2(z, np.hypot(x, y)), atol=1e-5)
