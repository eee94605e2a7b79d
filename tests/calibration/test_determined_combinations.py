"""Combinations of parameters that are known far better than each of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.calibration.evidence import determined_combinations
from ltsim.cli.main import run
from ltsim.physics.model.construction import misalignment_construction
from tests.networks import network


def test_a_sum_that_is_determined_is_reported_with_its_deviation() -> None:
    parameters = [p for p in misalignment_construction().parameters if p.unit == "urad"][:3]
    truth = np.array([3e-6, -1e-6, 2e-6])
    spread = np.eye(3) * 1e-12
    along = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    spread -= (1e-12 - 1e-16) * np.outer(along, along)
    (combination,) = determined_combinations(parameters, truth, spread)
    assert set(combination.combination) == {p.name for p in parameters[:2]}
    np.testing.assert_allclose(list(combination.combination.values()), [1.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose([combination.value, combination.sigma], [2.0, 0.01 * np.sqrt(2.0)], rtol=1e-6)


def test_separately_determined_parameters_make_no_combination() -> None:
    parameters = misalignment_construction().parameters[:4]
    assert not determined_combinations(parameters, np.zeros(4), np.diag([1.0, 2.0, 3.0, 4.0]) * 1e-12)


@pytest.mark.long
def test_a_single_face_tells_the_index_with_others_and_the_file_and_page_say_so(tmp_path: Path, capsys) -> None:
    recording, _ = network(faces=1, seed=6)
    calibration = lt.calibrate(recording)
    names = list(calibration.construction.parameter_names)
    for combination in calibration.determined:
        alone = min(calibration.sigma[0, names.index(name)] for name in combination.combination)
        assert combination.sigma is not None and combination.sigma * 1e-6 < alone * 10
    lt.write(recording, tmp_path / "rec")
    assert run(["calibrate", str(tmp_path / "rec"), "--out", str(tmp_path / "cal")]) == 0
    assert "The combination is determined far better than its single parameters" in capsys.readouterr().out
    content = json.loads((tmp_path / "cal" / "calibration.json").read_text())
    assert any("vertical-index" in entry["combination"] for entry in content["determined"])
    assert run(["report", str(tmp_path / "cal"), "-q"]) == 0
    assert "Determined in combination" in (tmp_path / "cal" / "report.html").read_text(encoding="utf-8")


def test_reported_combinations_have_the_uncertainty_of_their_weights() -> None:
    """Parameters that are left out of a combination leave its deviation true: it is that of what is told."""
    recording, _ = network(faces=1, seed=6)
    calibration = lt.calibrate(recording)
    assert calibration.determined
    for combination in calibration.determined:
        weights = np.array(
            [combination.combination.get(name, 0.0) for name in calibration.construction.parameter_names]
        )
        factor = next(
            p.si_per_display_unit for p in calibration.construction.parameters if p.name in combination.combination
        )
        np.testing.assert_allclose(
            combination.sigma, np.sqrt(weights @ calibration.covariance @ weights) / factor, rtol=1e-9
        )
        np.testing.assert_allclose(combination.value, weights @ calibration.estimates[0] / factor, rtol=1e-9)


def test_a_combination_has_the_name_of_the_vertical_index_and_not_of_a_harmonic() -> None:
    """The index precedes the harmonics in the model, and its coefficient is nearly the largest."""
    parameters = [p for p in misalignment_construction().parameters if p.name.startswith(("vertical", "elevation-s"))]
    along = np.array([0.86, 1.0, 0.0]) / np.hypot(0.86, 1.0)
    spread = np.eye(3) * 1e-12 - (1e-12 - 1e-16) * np.outer(along, along)
    (combination,) = determined_combinations(parameters, np.array([11e-6, 0.0, 0.0]), spread)
    assert list(combination.combination) == ["vertical-index", "elevation-second-order-cos"]
    assert combination.value == pytest.approx(11.0)
