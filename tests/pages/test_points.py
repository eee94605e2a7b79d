"""Adjusted points for other programs: read back by somebody else's library, the coordinates are the same."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import trimesh

import ltsim as lt
from ltsim.calibration import Calibration
from ltsim.errors import RecordError
from ltsim.pages.points import write_points
from tests.pages import samples


@pytest.fixture(scope="module")
def found() -> Calibration:
    return lt.adjust(samples.recording())


def test_a_point_cloud_holds_millimetres(found: Calibration, tmp_path: Path) -> None:
    write_points(found, tmp_path / "points.ply")
    cloud = trimesh.load(tmp_path / "points.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_allclose(cloud.vertices, 1e3 * found.points, atol=5.1e-7)
    text = (tmp_path / "points.ply").read_text()
    assert "comment unit mm" in text
    assert "comment point 0 T01" in text
    sigma = cloud.metadata["_ply_raw"]["vertex"]["data"]["sigma_z"].ravel()
    np.testing.assert_allclose(sigma, 1e3 * np.sqrt(found.target_covariance[:, 2, 2]), atol=5.1e-7)


def test_markers_are_named_and_in_place(found: Calibration, tmp_path: Path) -> None:
    write_points(found, tmp_path / "points.glb")
    scene = trimesh.load(tmp_path / "points.glb")
    for name, point in zip(found.targets, found.points, strict=True):
        transform, geometry = scene.graph[name]
        np.testing.assert_allclose(transform[:3, 3], point, atol=1e-12)
        assert geometry.startswith("reflector")
    for station in found.stations:
        np.testing.assert_allclose(scene.graph[f"station {station.name}"][0][:3, 3], station.position, atol=1e-12)
    assert (tmp_path / "points.glb").stat().st_size < 40_000  # one mesh, many nodes


def test_a_table_is_that_of_the_calibration(found: Calibration, tmp_path: Path) -> None:
    write_points(found, tmp_path / "points.csv")
    rows = list(csv.DictReader((tmp_path / "points.csv").read_text().splitlines()))
    assert [row["target"] for row in rows] == list(found.targets)
    np.testing.assert_allclose([float(row["x_mm"]) for row in rows], 1e3 * found.points[:, 0], atol=5.1e-7)


def test_another_suffix_is_refused_with_a_sentence(found: Calibration, tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"written as \.csv, \.ply, \.glb"):
        write_points(found, tmp_path / "points.step")
    assert list(tmp_path.iterdir()) == []
