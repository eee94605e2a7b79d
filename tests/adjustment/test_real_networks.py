"""Networks that nobody here made, where they lie beside the checkout; see experiments/04_real_networks/README.md."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.centring import estimate_centring_errors
from ltsim.recordings import read

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "recordings"
EXPERIMENT = ROOT / "experiments" / "04_real_networks"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/recordings is not beside this checkout")
pytestmark = [needs_data, pytest.mark.skipif(not EXPERIMENT.is_dir(), reason="the experiments are not here")]


@pytest.fixture(scope="module")
def experiment():
    """The experiment's functions."""
    return import_module("experiments.04_real_networks.run")


@pytest.mark.parametrize("name", ["local_3d", "2020-barta-phase_0-1TK"])
def test_gama_free_networks_agree_to_the_printed_digit(experiment, name):
    ours, theirs = adjust(read(DATA / "gama-3d-networks" / f"{name}.gkf")), experiment.gama_result(name)
    assert ours.dof == theirs.dof
    assert ours.sigma0 * theirs.apriori == pytest.approx(theirs.aposteriori, rel=5e-5)
    assert np.abs(experiment.difference(ours, name)).max() < 5e-7
    assert np.abs(experiment.sigma_ratio(ours, name) - 1).max() < 0.001
    assert ours.chi2 * theirs.apriori**2 <= theirs.square_sum


def test_a_network_with_reference_points_in_plan_and_in_space_agrees_with_gama():
    published = import_module("experiments.04_real_networks.published")
    theirs = published.gama_result("2019-zeman", "field")
    ours = adjust(read(DATA / "field" / "2019-zeman.gkf"))
    assert ours.dof == theirs.dof
    assert ours.sigma0 == pytest.approx(theirs.aposteriori, rel=5e-8)
    assert ours.chi2 == pytest.approx(theirs.square_sum, rel=5e-8)
    assert (
        np.abs(published.coordinates_and_sigmas(ours, theirs)[0] - theirs.value).max() < 2.5e-6
    )  # 1e-4 of their sigmas, where Gama stopped: it prints 1e-5 m


def test_a_network_in_plan_has_the_sigma0_of_an_independent_adjustment():
    adjustment = adjust(read(DATA / "field" / "praha_hrad1010.gkf"))
    assert adjustment.solution.has_converged
    assert adjustment.is_height_undetermined_target.all()
    assert np.isnan(adjustment.target_covariances[:, 2]).all()
    assert np.isfinite(adjustment.target_covariances[:, :2, :2]).all()
    assert adjustment.sigma0 == pytest.approx(0.97, abs=0.005)


def test_a_local_tie_names_the_tripod_of_the_second_day_and_places_what_directions_see():
    adjustment = adjust(read(DATA / "field" / "wark_control.csv"))
    moved = estimate_centring_errors(adjustment)
    assert moved is not None
    assert [(occupation.mark, occupation.role, occupation.day) for occupation in moved.occupations] == [
        ("WAN3", "target", "2015-03-16")
    ]
    turn = np.radians(156.5)  # azimuth of the network's x axis, WAN3 to WANE
    axes = np.array([[np.sin(turn), np.cos(turn)], [-np.cos(turn), np.sin(turn)]])
    spread = np.sqrt(np.diag(axes.T @ moved.shift_covariances[0] @ axes))
    assert np.all(np.abs(moved.shifts[0] @ axes - [1.5e-3, 1.0e-3]) < 2.0 * spread)
    assert spread.max() < 0.3e-3
    assert moved.noisy_targets == ("WARK",)
    assert not adjustment.undetermined_targets
    assert np.flatnonzero(adjustment.is_height_undetermined_target).tolist() == [
        adjustment.recording.targets.index("WARK")
    ]
    without = adjustment.recording.select(adjustment.recording.target != adjustment.recording.targets.index("WARK"))
    marks = adjust(without)
    assert marks.dof == 562
    assert marks.chi2 == pytest.approx(1514, rel=5e-3)


def test_gama_stopped_short_where_the_coordinates_differ(experiment):
    name = "2019-prager"
    ours, theirs = adjust(read(DATA / "gama-3d-networks" / f"{name}.gkf")), experiment.gama_result(name)
    assert ours.dof == theirs.dof
    assert ours.sigma0 == pytest.approx(theirs.aposteriori, abs=5e-4)
    assert 2.5e-5 < np.abs(experiment.difference(ours, name)).max() < 3e-5
    assert ours.chi2 < theirs.square_sum - 0.05
    assert experiment.best_turns(ours, name) > ours.chi2 + 10
    assert np.sum(np.abs(experiment.sigma_ratio(ours, name) - 1) > 0.02) == 1
    between_marks = adjust(experiment.to_marks(ours), start_state=ours.state)
    assert np.abs(experiment.sigma_ratio(between_marks, name) - 1).max() < 0.001


def test_esa_adjusts_and_outliers_are_detected():
    adjustment = adjust(read(DATA / "cern-lgc-trackers" / "20697_V2_Dirk_ESA_experimental.lgc"), robust=True)
    assert adjustment.solution.has_converged
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.01)
    assert not adjustment.flagged_readings()
    rows = {int(i) + 1 for i in np.flatnonzero(adjustment.is_rejected_reading.any(axis=1))}
    assert {42, 199, 361, 362} <= rows
    assert 41 not in rows
    assert adjustment.is_rejected_reading.sum() < 20
    for row in (199, 362):
        assert adjustment.residuals[row - 1, 2] * adjustment.recording.readings[row - 1, 0] == pytest.approx(
            0.07, abs=0.002
        )


def test_the_arc_adjusts_with_all_statistics():
    recording = read(DATA / "cern-lgc-trackers" / "Arc_2_3.lgc")
    adjustment = adjust(recording)
    spread, poses, redundancy = adjustment.target_covariances, adjustment.pose_covariance, adjustment.redundancy
    assert adjustment.solution.has_converged
    assert adjustment.problem.free_motions.shape[1] == 1
    assert adjustment.sigma0 == pytest.approx(0.637, abs=0.002)
    assert np.isfinite(spread).all() and np.isfinite(poses).all()
    assert np.nansum(redundancy) == pytest.approx(adjustment.dof, abs=0.01)


@pytest.mark.long
def test_two_faces_of_a_total_station_on_marks():
    adjustment = adjust(read(DATA / "geoeasy-total-station-22st" / "network.GSI"), noise_grouping="observable")
    assert adjustment.solution.has_converged
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.005)
    factors = {c.observable: c.noise_factor for c in adjustment.variance_components}
    assert factors["distance"] == pytest.approx(0.48, abs=0.03)
    assert factors["level"] > 5


@pytest.mark.parametrize("has_points", [True, False])
def test_parameters_of_the_simulated_scanner_are_recovered(experiment, has_points):
    values, sigma = experiment.fit_parameters(experiment.scanner(has_points), has_points)
    assert np.all(np.abs(values - experiment.TRUTH) < 3.2 * sigma)
    exact, _ = experiment.fit_parameters(experiment.rounded_scans(None), has_points)
    np.testing.assert_allclose(exact, experiment.TRUTH, atol=1.0)


@pytest.mark.parametrize("has_points", [True, False], ids=["points known", "points unknown"])
def test_four_parameters_of_the_scanner_are_better_determined_than_sixteen(experiment, has_points):
    ratio = {row["parameter"]: float(row["sigma_ratio"]) for row in experiment.choice_of_parameters(has_points)}
    assert ratio["vertical-index"] > 10
    assert ratio["beam-tilt"] > 5
    assert ratio["range-offset"] > 3
    assert ratio["transit-tilt"] >= 1.0
