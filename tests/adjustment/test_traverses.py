"""Traverses in plan: whatever has full rank is solved, from directions and from lengths read by the neighbours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.axes import with_control_points
from ltsim.adjustment.identification.recommendations import recommendations_for_causes
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.recommendations import inspection_action
from ltsim.recordings import read

COUNT = 11
OCCUPIED = (1, 2, 3, 4, 5, 5, 6, 7, 8, 9)
"""Set-ups in order: point 5 is occupied twice, the ends never."""


def traverse(file: Path, *, ends: str = "both", skipped: tuple[int, int] | None = None) -> Floats:
    """An open traverse of 11 points in plan: directions to both neighbours, lengths from every second set-up only.

    Both ends have coordinates, or one, or none; one leg has no length where it is `skipped`. The points (11, 2) [m].
    """
    rng = np.random.default_rng(2)
    points = np.cumsum(np.column_stack([rng.uniform(60, 120, COUNT), rng.uniform(-40, 40, COUNT)]), axis=0)
    rows = ['<gama-local><network axes-xy="en" angles="left-handed"><parameters sigma-apr="1" sigma-act="apriori"/>']
    rows.append('<points-observations direction-stdev="3" distance-stdev="1">')
    for i, (x, y) in enumerate(points.tolist()):
        reference_axes = {0: ("both", "one"), COUNT - 1: ("both",)}.get(i, ())
        place = f'x="{x:.4f}" y="{y:.4f}"' if ends in reference_axes else ""
        rows.append(
            f'<point id="{i}" {place} {"fix" if place and not i else "adj"}="{"XY" if place and i else "xy"}"/>'
        )
    for i in OCCUPIED:
        rows.append(f'<obs from="{i}">')
        zero = rng.uniform(0, 400)
        for j in (i - 1, i + 1):
            east, north = points[j] - points[i]
            turn = np.arctan2(east, north) * 200 / np.pi + zero + rng.normal(0, 3e-4)
            rows.append(f'<direction to="{j}" val="{turn % 400:.5f}"/>')
            if (i % 2 == 0 or j in (0, COUNT - 1)) and skipped != (i, j):
                rows.append(f'<distance to="{j}" val="{np.hypot(east, north) + rng.normal(0, 1e-3):.4f}"/>')
        rows.append("</obs>")
    file.write_text("\n".join([*rows, "</points-observations></network></gama-local>"]))
    return points


def spans(points: Floats) -> Floats:
    return np.asarray(np.linalg.norm(points[:, None] - points[None], axis=2))


@pytest.mark.parametrize("ends", ["both", "one", "none"])
def test_an_open_traverse_is_solved_from_any_order(tmp_path: Path, ends: str) -> None:
    points = traverse(tmp_path / "a.gkf", ends=ends)
    recording = read(tmp_path / "a.gkf")
    for rows in (np.arange(len(recording)), np.arange(len(recording))[::-1]):
        adjusted = lt.adjust(recording.select(rows))
        at = [int(name) for name in adjusted.target_names]
        np.testing.assert_allclose(spans(adjusted.target_points[:, :2]), spans(points[at]), atol=0.02)
        assert adjusted.fit.dof == 1


def test_a_leg_without_a_length_is_named(tmp_path: Path) -> None:
    traverse(tmp_path / "a.gkf", skipped=(4, 3))
    with pytest.raises(NetworkError, match=r"no reading determines the horizontal length of the lines 3-4$"):
        lt.adjust(read(tmp_path / "a.gkf"))


def test_a_wrong_height_of_a_set_up_with_two_pointings_is_no_physics(tmp_path: Path) -> None:
    """A levelled polygon of five points, one of which is occupied twice: one of its instrument heights is omitted."""
    rng = np.random.default_rng(4)
    turn = np.arange(5) * 2 * np.pi / 5
    points = np.column_stack([60 * np.sin(turn), 55 * np.cos(turn), [0.0, 1.5, 4.0, 2.0, -0.5]])
    rows = ['<gama-local><network axes-xy="en" angles="left-handed"><parameters sigma-apr="1" sigma-act="apriori"/>']
    rows.append('<points-observations direction-stdev="6" zenith-angle-stdev="6" distance-stdev="1">')
    rows += [f'<point id="{name}" adj="xyz"/>' for name in "ABCDE"]
    for i, true_height, declared_height in (
        (0, 0.0, 0.0),
        (1, 0.0, 0.0),
        (1, 0.25, 0.0),
        *((i, 0.0, 0.0) for i in (2, 3, 4)),
    ):
        rows.append(f'<obs from="{"ABCDE"[i]}">')
        zero, height = rng.uniform(0, 400), f'from_dh="{declared_height}" to_dh="0"'
        for j in ((i - 1) % 5, (i + 1) % 5):
            east, north, up = points[j] - points[i] - [0.0, 0.0, true_height]
            plan, to = np.hypot(east, north), f'to="{"ABCDE"[j]}"'
            turned = np.arctan2(east, north) * 200 / np.pi + zero + rng.normal(0, 6e-4)
            zenith = np.arctan2(plan, up) * 200 / np.pi + rng.normal(0, 6e-4)
            rows.append(f'<direction {to} val="{turned % 400:.5f}"/><z-angle {to} val="{zenith:.5f}" {height}/>')
            rows.append(f'<s-distance {to} val="{np.hypot(plan, up) + rng.normal(0, 1e-3):.5f}" {height}/>')
        rows.append("</obs>")
    file = tmp_path / "polygon.gkf"
    file.write_text("\n".join([*rows, "</points-observations></network></gama-local>"]))
    recording = read(file)
    (wrong,) = adjust(recording).rejected_references
    assert (wrong.kind, wrong.name) == ("mark", "B#2")
    (finding,) = diagnose(recording, held_out=False).findings
    assert finding.where.stations == ("B#2",)
    assert finding.sentence.startswith("The set-up of B#2 is off by 2")
    assert finding.sentence.endswith("above its mark: check the height of the instrument, which is declared too low.")
    action = "Check the height and the centring of set-up B#2 over its mark."
    assert recommendations_for_causes(lt.adjust(recording).tests) == [action] == [inspection_action(finding)]


@pytest.mark.parametrize("reverses_rows", [False, True])
def test_closed_traverse_in_space_with_lengths_of_the_neighbours(tmp_path: Path, *, reverses_rows: bool) -> None:
    """Two of seven set-ups read no distance; each of their legs has a length from the opposite set-up."""
    rng = np.random.default_rng(3)
    angle = np.linspace(0.0, 2 * np.pi, 7, endpoint=False)
    points = np.column_stack([200 * np.cos(angle), 150 * np.sin(angle), rng.normal(0, 3, 7)])
    points[:, :2] += rng.normal(0, 15, (7, 2))
    rows = []
    for i in range(7):
        zero = rng.uniform(0, 360)
        for j in ((i - 1) % 7, (i + 1) % 7):
            east, north, up = points[j] - points[i] + [0, 0, 1.70 - 1.55]
            length = np.linalg.norm([east, north, up])
            turn = (np.degrees(np.arctan2(east, north)) - zero + rng.normal(0, 3e-4)) % 360
            zenith = np.degrees(np.arccos(up / length)) + rng.normal(0, 3e-4)
            distance = "" if i in (1, 4) else f"{length + rng.normal(0, 1e-3):.4f}"
            rows.append(f"T{i};T{j};1.55;1.70;{turn:.5f};{zenith:.5f};{distance}")
    lines = ["Station;Target;IH;TH;Hz [deg];Zenith [deg];SD [m]", *(reversed(rows) if reverses_rows else rows)]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    adjustment = adjust(read(tmp_path / "a.csv"))
    assert adjustment.dof == 14
    order = [adjustment.recording.targets.index(f"T{i}") for i in range(7)]
    places = adjustment.state.target_points[order]
    sides, expected = (np.linalg.norm(p[:, None] - p[None], axis=2) for p in (places, points))
    assert np.abs(sides - expected).max() < 0.01


def spatial_traverse(file: Path, legs: list[tuple[int, int]]) -> Path:
    """A table of the sights, from the first to the second point of each leg, between set-ups over their marks."""
    angle = np.linspace(0.0, 2 * np.pi, 7, endpoint=False)
    points = np.column_stack([200 * np.cos(angle), 150 * np.sin(angle), 3 * np.sin(3 * angle)])
    rows = ["Station;Target;IH;TH;Hz [deg];Zenith [deg];SD [m]"]
    for i, j in legs:
        east, north, up = points[j] - points[i] + [0, 0, 1.70 - 1.55]
        length = np.linalg.norm([east, north, up])
        turn, zenith = np.degrees([np.arctan2(east, north), np.arccos(up / length)])
        rows.append(f"T{i};T{j};1.55;1.70;{(turn - 40 * i) % 360:.5f};{zenith:.5f};{length:.4f}")
    file.write_text("\n".join(rows) + "\n")
    return file


def test_separate_parts_of_a_network_are_named(tmp_path: Path) -> None:
    """Earlier: the stations of one part share only 0 targets with the network."""
    legs = [(i, j) for part in ((0, 1, 2), (3, 4, 5)) for i in part for j in part if i != j]
    says = "2 separate parts: stations T3, T4, T5 measured no point that stations T0, T1, T2 measured"
    with pytest.raises(NetworkError, match=says):
        adjust(read(spatial_traverse(tmp_path / "a.csv", legs)))


def test_a_traverse_without_backsights_names_the_undetermined_direction(tmp_path: Path) -> None:
    """Each set-up stands over a point with coordinates, but nothing determines its horizontal circle."""
    file = spatial_traverse(tmp_path / "a.csv", [(i, i + 1) for i in range(5)])
    message = "station T1 stands over a point with coordinates, .*direction of its horizontal circle is undetermined"
    with pytest.raises(NetworkError, match=f"{message}.*T2, T3, T4 cannot be located; measure a backsight"):
        adjust(read(file))


def test_a_part_with_a_single_reference_point_names_its_undetermined_rotation(tmp_path: Path) -> None:
    """Earlier: the observations with their declared noise do not determine all unknowns."""
    legs = [(i, j) for part in ((0, 1, 2), (3, 4, 5)) for i in part for j in part if i != j]
    recording = read(spatial_traverse(tmp_path / "a.csv", legs))
    angle = np.linspace(0.0, 2 * np.pi, 7, endpoint=False)
    lines = [
        f"T{i},{200e3 * np.cos(angle[i]):.3f},{150e3 * np.sin(angle[i]):.3f},{3e3 * np.sin(3 * angle[i]):.3f},1"
        for i in (0, 1, 4)
    ]
    (tmp_path / "control.csv").write_text("\n".join(["target,x_mm,y_mm,z_mm,sigma_mm", *lines]) + "\n")
    recording = with_control_points(recording, tmp_path / "control.csv")
    flat = {"curved": False, "refraction": None}  # on a round earth, plumb lines of levels would tell the direction
    recording = recording.replace(setup=recording.setup.model_copy(update=flat))
    says = r"the positions of T5, T3 \(they can rotate together about a vertical axis through T4\) .*set-up T4"
    with pytest.raises(NetworkError, match=says):
        lt.adjust(recording)
