"""Control points in a check: a file of coordinates counts like readings, and a wrong one is named."""

from __future__ import annotations

from pathlib import Path

import pytest

import ltsim as lt
from ltsim.cli.main import run


@pytest.mark.parametrize(("error_mm", "status"), [(0.0, 0), (2.0, 1), (500.0, 1)])
def test_a_check_names_a_wrong_control_point(
    error_mm: float, status: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, _ = lt.simulate("paper-workshop-two-face", seed=4)
    lt.write(recording, tmp_path / "rec")
    points = lt.calibrate(recording).target_points.copy() * 1e3
    points[8, 1] += error_mm
    rows = [f"{recording.targets[i]},{x:.6f},{y:.6f},{z:.6f},0.05" for i, (x, y, z) in list(enumerate(points))[::4]]
    rows += [f"{name},1,2,3,0.05" for name in ("Q1", "Q2")]
    (tmp_path / "control.csv").write_text("\n".join(["target,x_mm,y_mm,z_mm,sigma_mm", *rows]) + "\n")
    assert run(["check", str(tmp_path / "rec"), "--control", str(tmp_path / "control.csv")]) == status
    out, err = capsys.readouterr()
    first = out.split("\n\n")[1]
    assert "2 points of control.csv are not used, because no pointing measures them: Q1, Q2" in err
    assert first.startswith("No-go" if status else "Go")
    assert not status or recording.targets[8] in first
