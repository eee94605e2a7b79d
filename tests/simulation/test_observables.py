"""A tracker of which only some readings are recorded: ranges alone are multilateration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.campaigns.true_network import make_true_network
from ltsim.core.errors import InputError
from ltsim.geometry.rigid import align_with_scale
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.search_inputs import planned_survey
from ltsim.recordings.setup import Target
from ltsim.simulation.truth import Truth

RANGES = {"instrument.observables": ["distance"]}


def test_multilateration_from_scenario_to_coordinates(tmp_path: Path) -> None:
    scenario = lt.scenario("paper-workshop", {**RANGES, "instrument.errors": {"draw": False}})
    recording, truth = lt.simulate(scenario, seed=3)
    assert np.isfinite(recording.readings[:, 0]).all()
    assert np.isnan(recording.readings[:, 1:]).all()
    lt.write(recording, tmp_path / "rec")
    assert "mirror image" in repr(lt.adjust(tmp_path / "rec"))
    rough = {name: Target(approximate_mm=tuple(np.round(1000 * p, -2).tolist())) for name, p in _places(truth)[::5]}
    recording_read = lt.read(tmp_path / "rec")
    adjustment = lt.adjust(recording_read.replace(setup=recording_read.setup.model_copy(update={"targets": rough})))
    assert "mirror image" not in repr(adjustment)
    places = dict(zip(adjustment.target_names, adjustment.target_points, strict=True))
    points = np.array([places[name] for name in truth.target_names])
    rotation, shift, _ = align_with_scale(truth.target_points, points)
    gap = points - (truth.target_points @ rotation.T + shift)
    assert np.sqrt(np.mean(gap**2)) < 30e-6
    assert adjustment.fit.p_value is not None
    assert adjustment.fit.p_value > 0.001


def _places(truth: Truth) -> list[tuple[str, np.ndarray]]:
    return list(zip(truth.target_names, truth.target_points, strict=True))


def test_a_calibration_from_ranges_tells_of_no_new_point() -> None:
    recording, _ = lt.simulate(lt.scenario("paper-workshop", RANGES), seed=3)
    calibration = lt.calibrate(recording)
    assert "expected error of a new point" not in repr(calibration)
    sigma_ratio = dict(
        zip(calibration.instrument_parameter_names, calibration.sigma[0] / calibration.prior_sigma[0], strict=True)
    )
    assert sigma_ratio["range-scale"] < 0.999
    assert sigma_ratio["beam-tilt"] == pytest.approx(1.0)


def test_a_plan_and_trials_know_ranges_alone_and_nothing_between() -> None:
    assert not planned_survey(lt.scenario("paper-workshop", RANGES)).records_angles
    assert make_true_network(lt.scenario("paper-workshop", RANGES), 1).is_recorded_observable.tolist() == [
        True,
        False,
        False,
    ]
    angles = lt.scenario("paper-workshop", {"instrument.observables": ["azimuth", "elevation"]})
    with pytest.raises(InputError, match="or ranges only"):
        planned_survey(angles)


def test_a_level_tells_nothing_of_ranges() -> None:
    """Levels tie an axis that no range sees: the network keeps its six free motions, instruments stand upright."""
    levels = {f"stations.S{i}.levelled": True for i in range(1, 6)}
    recording, _ = lt.simulate(lt.scenario("paper-workshop", {**RANGES, **levels}), seed=3)
    adjustment = adjust(recording, misalignment_construction())
    assert adjustment.problem.free_motions.shape[1] == 6
    assert not len(adjustment.problem.level_rows)
    np.testing.assert_allclose(adjustment.state.station_rotations[:, 2, 2], 1.0, atol=1e-9)
