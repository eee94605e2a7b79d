"""A tracker of which only some readings are recorded: ranges alone are multilateration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.campaign.cell import truth_of
from ltsim.errors import SetupError
from ltsim.plan.workshop import survey_of
from ltsim.recording.setup import Target
from ltsim.simulate.truth import Truth
from ltsim.uncertainty.measurands import best_fit

RANGES = {"instrument.observables": ["distance"]}


def test_multilateration_from_scenario_to_coordinates(tmp_path: Path) -> None:
    scenario = lt.scenario("paper-workshop", {**RANGES, "instrument.errors": {"draw": False}})
    recording, truth = lt.simulate(scenario, seed=3)
    assert np.isfinite(recording.readings[:, 0]).all()
    assert np.isnan(recording.readings[:, 1:]).all()
    lt.write(recording, tmp_path / "rec")
    assert "mirror image" in repr(lt.adjust(tmp_path / "rec"))
    rough = {name: Target(approximate_mm=tuple(np.round(1000 * p, -2).tolist())) for name, p in _places(truth)[::5]}
    stated = lt.read(tmp_path / "rec")
    found = lt.adjust(stated.replace(setup=stated.setup.model_copy(update={"targets": rough})))
    assert "mirror image" not in repr(found)
    places = dict(zip(found.targets, found.points, strict=True))
    points = np.array([places[name] for name in truth.targets])
    rotation, shift, _ = best_fit(truth.points, points)
    gap = points - (truth.points @ rotation.T + shift)
    assert np.sqrt(np.mean(gap**2)) < 30e-6
    assert found.fit.p_value is not None
    assert found.fit.p_value > 0.001


def _places(truth: Truth) -> list[tuple[str, np.ndarray]]:
    return list(zip(truth.targets, truth.points, strict=True))


def test_a_calibration_from_ranges_tells_of_no_new_point() -> None:
    recording, _ = lt.simulate(lt.scenario("paper-workshop", RANGES), seed=3)
    found = lt.calibrate(recording)
    assert "expected error of a new point" not in repr(found)
    known = dict(zip(found.names, found.sigma[0] / found.prior_sigma[0], strict=True))
    assert known["range-scale"] < 0.999
    assert known["beam-tilt"] == pytest.approx(1.0)


def test_what_needs_whole_pointings_says_so() -> None:
    scenario = lt.scenario("paper-workshop", RANGES)
    with pytest.raises(SetupError, match="observables leaves readings out; trials"):
        truth_of(scenario, 1)
    with pytest.raises(SetupError, match="observables leaves readings out; a plan"):
        survey_of(scenario)
