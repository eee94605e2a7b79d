"""Long sights of levelled set-ups: plumb lines of a round earth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.axes import with_axes_from_points, with_control_points, with_levelled_control_note
from ltsim.adjustment.level_surface import level_surface_log_evidence
from ltsim.adjustment.significance import MIN_LOG_EVIDENCE_CERTAIN
from ltsim.cli.options import ReadingOptionsWithControl
from ltsim.core.units import EARTH_RADIUS
from ltsim.recordings import Hints, read, write
from ltsim.recordings.coordinates import read_points

CORNERS = {"A": (0.0, 0.0, 1.5), "B": (600.0, 80.0, 4.0), "C": (250.0, 520.0, 9.0)}
ARCSECOND = np.pi / 648_000
LEVELS = "\n".join(
    f"[stations.{name}]\nlevelled = true\nlevelling_sigma_arcsec = 0.3\nover = '{name}'" for name in CORNERS
)


def survey(folder: Path, *, size: float = 1.0, further: str = "", refraction: float = 0.0) -> Path:
    """A total station on three pillars, 600 m apart times `size`: noise of 0.5 arcsec and 0.6 mm."""
    rng = np.random.default_rng(8)
    corners = {name: size * np.array(place) for name, place in CORNERS.items()}
    points = corners | {f"W{i}": size * rng.uniform([0, 0, 0], [600, 500, 25]) for i in range(8)}
    rows = ["Station;Point;Hz [gon];V [gon];D [m]"]
    for name, place in corners.items():
        lean = np.array([*(place[:2] / EARTH_RADIUS), 1.0])
        up = lean / np.linalg.norm(lean)
        east = np.cross([0.0, 1.0, 0.0], up)
        east /= np.linalg.norm(east)
        axes = np.array([east, np.cross(up, east), up])
        for target in (t for t in points if t != name):
            arm = axes @ (points[target] - place)
            length = float(np.linalg.norm(arm))
            hz = np.arctan2(arm[0], arm[1]) + rng.normal(0.0, 0.5) * ARCSECOND / np.hypot(arm[0], arm[1]) * length
            zenith = (
                np.arccos(arm[2] / length) - refraction * length / (2 * EARTH_RADIUS) + rng.normal(0.0, 0.5) * ARCSECOND
            )
            printed = np.array([hz % (2 * np.pi), zenith]) * 200 / np.pi
            rows.append(f"{name};{target};{printed[0]:.6f};{printed[1]:.6f};{length + rng.normal(0, 6e-4):.5f}")
    (folder / "survey.csv").write_text("\n".join(rows) + "\n")
    noise = "distance_mm = 0.6\ndistance_ppm = 0.0\nazimuth_arcsec = 0.5\nelevation_arcsec = 0.5"
    (folder / "known.toml").write_text(
        f'format = "ltsim-recording/1"\n{further}\n[instrument.noise]\n{noise}\n{LEVELS}\n'
    )
    lines = [f"{n},{','.join(f'{1e3 * x:.3f}' for x in p)}" for n, p in points.items()]
    (folder / "true.csv").write_text("\n".join(["target,x_mm,y_mm,z_mm", *lines]) + "\n")
    return folder / "survey.csv"


def hints(folder: Path) -> Hints:
    return Hints(setup=folder / "known.toml")


def test_long_sights_of_levelled_set_ups_are_on_a_round_earth(tmp_path: Path) -> None:
    recording = read(survey(tmp_path), hints=hints(tmp_path))
    assert recording.setup.curved
    assert sum("the plumb lines of the set-ups follow the curved earth" in note for note in recording.notes) == 1
    assert 0.7 < lt.adjust(recording).fit.sigma0 < 1.3
    flat = recording.replace(setup=recording.setup.model_copy(update={"curved": False, "refraction": None}))
    assert lt.adjust(flat).fit.sigma0 > 2.0


def test_coordinates_that_are_given_need_not_stand_along_the_plumb_line_of_the_middle(tmp_path: Path) -> None:
    """Their z is the plumb line at A, 12 arcsec from that in the middle of the network."""
    recording = read(survey(tmp_path), hints=hints(tmp_path))
    points = read_points(tmp_path / "true.csv").coordinates_by_name
    adjusted = lt.adjust(with_axes_from_points(recording, points, "true.csv"))
    assert 0.7 < adjusted.fit.sigma0 < 1.3
    true = np.loadtxt(tmp_path / "true.csv", delimiter=",", skiprows=1, usecols=(1, 2, 3)) * 1e-3
    names = [line.split(",")[0] for line in (tmp_path / "true.csv").read_text().splitlines()[1:]]
    at = [names.index(name) for name in adjusted.target_names]
    assert np.abs(adjusted.target_points - true[at]).max() < 3e-3


@pytest.mark.parametrize("refraction", [0.0, 0.13, 0.3])
def test_the_coefficient_of_refraction_is_estimated(tmp_path: Path, refraction: float) -> None:
    recording = read(survey(tmp_path, refraction=refraction), hints=hints(tmp_path))
    assert recording.setup.refraction == (0.13, 0.1)
    assert sum("coefficient of refraction" in note for note in recording.notes) == 1
    adjusted = adjust(recording)
    assert 0.7 < adjusted.sigma0 < 1.3
    (difference,) = adjusted.state.extra_parameters
    assert 0.13 + difference == pytest.approx(refraction, abs=0.05)
    straight = recording.replace(setup=recording.setup.model_copy(update={"refraction": None}))
    assert (adjust(straight).chi2 > adjusted.chi2 + 50.0) == (refraction > 0.2)


def test_a_declared_coefficient_stays(tmp_path: Path) -> None:
    recording = read(survey(tmp_path, further="refraction = [0.3, 0.01]", refraction=0.3), hints=hints(tmp_path))
    assert recording.setup.refraction == (0.3, 0.01)
    assert adjust(recording).state.extra_parameters == pytest.approx([0.0], abs=0.03)


@pytest.mark.parametrize(("size", "further"), [(0.003, ""), (1.0, "curved = false")])
def test_short_sights_and_what_a_person_states_stay_as_they_are(tmp_path: Path, size: float, further: str) -> None:
    recording = read(survey(tmp_path, size=size, further=further), hints=hints(tmp_path))
    assert not recording.setup.curved and recording.setup.refraction is None
    assert not any("curved earth" in note for note in recording.notes)


@pytest.mark.parametrize("refraction", [0.0, 0.13])
def test_levelled_heights_in_a_frame_are_reported(tmp_path: Path, refraction: float) -> None:
    """Heights of an office are above a level surface; the network is Cartesian. Earlier, they misfitted silently."""
    recording = read(survey(tmp_path, size=2.0, refraction=refraction), hints=hints(tmp_path))
    cartesian = read_points(tmp_path / "true.csv").coordinates_by_name
    centre = np.mean([*cartesian.values()], axis=0)
    levelled = {
        name: place + [0.0, 0.0, np.sum((place - centre)[:2] ** 2) / (2 * EARTH_RADIUS)]
        for name, place in cartesian.items()
    }
    for places, is_reported in ((levelled, True), (cartesian, False)):
        lines = [f"{name},{','.join(f'{1e3 * x:.3f}' for x in place)},1" for name, place in places.items()]
        (tmp_path / "list.csv").write_text("\n".join(["target,x_mm,y_mm,z_mm,sigma_mm", *lines]) + "\n")
        control = with_control_points(recording, tmp_path / "list.csv")
        write(control, tmp_path / str(is_reported))
        for aligned, file in (
            (with_axes_from_points(recording, places, "list.csv"), "list.csv"),
            (with_levelled_control_note(control, "list.csv"), "list.csv"),
            (ReadingOptionsWithControl().read(tmp_path / str(is_reported)), "setup.toml"),
        ):
            notes = [note for note in aligned.notes if f"the heights in {file} are above a level surface" in note]
            assert len(notes) == is_reported
            assert all("subtract d^2 / (2 R) from each height" in note for note in notes)


def test_scatter_of_heights_is_no_level_surface() -> None:
    """At most one in a thousand sets of heights with errors of any size looks like a level surface by chance."""
    rng = np.random.default_rng(4)
    offsets = rng.uniform(-800.0, 800.0, (7, 2))
    offsets -= offsets.mean(axis=0)
    departures = np.sum(offsets**2, axis=1) / (2 * EARTH_RADIUS)
    chance = [level_surface_log_evidence(offsets, rng.normal(0.0, 0.03, 7)) for _ in range(2000)]
    assert np.mean(np.array(chance) > MIN_LOG_EVIDENCE_CERTAIN) <= 0.003
    assert level_surface_log_evidence(offsets, departures + rng.normal(0.0, 0.002, 7)) > MIN_LOG_EVIDENCE_CERTAIN
