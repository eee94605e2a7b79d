"""Standard deviations as they are reported: in a rejected fit, over long ranges, and against those of the plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.coordinate_uncertainty import COVARIANCE_FILE_NAME
from ltsim.core.errors import RecordError
from ltsim.core.randomness import random_stream
from ltsim.recordings.coordinates import read_coordinates

PLAN = """
format = "ltsim-plan/1"
[workshop]
size_mm = [24000, 9000, 6000]
[instrument]
preset = "modern"
[stations]
count = 2
min_stations_per_target = 2
[search]
starts = 1
grid_step_mm = 3000
yaw_count = 1
height_count = 1
"""
POINTS = [(3, 1, 1), (10, 8, 2), (16, 1, 4), (21, 7, 1), (12, 4.5, 5), (5, 7, 3), (19, 2, 2), (8, 1, 1.5)]


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a plan of a long hall."""
    folder = tmp_path_factory.mktemp("hall")
    rows = [f"P{i},{1e3 * x:g},{1e3 * y:g},{1e3 * z:g}" for i, (x, y, z) in enumerate(POINTS, 1)]
    (folder / "points.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n", encoding="utf-8")
    text = PLAN.replace("[workshop]", 'points = "points.csv"\n[workshop]') + "[work]\nfaces = 2\n"
    (folder / "hall.toml").write_text(text, encoding="utf-8")
    lt.write(lt.plan(folder / "hall.toml", seed=1), folder / "plan")
    return folder


def expanded(table: object, names: list[str], columns: str) -> np.ndarray:
    """Columns (T, 3) of a data frame by target."""
    return table.set_index("target").loc[names][columns.split()].to_numpy(float)  # type: ignore[attr-defined]


def test_the_measured_uncertainty_is_the_planned_uncertainty(hall: Path) -> None:
    plan = lt.read(hall / "plan")
    assert any("air" in reason for reason in plan.reasons)
    names = [r.name for r in plan.reflectors]
    recording, _ = lt.simulate(hall / "plan" / "scenario.toml", seed=4)
    measured = lt.calibrate(recording, datum=names, advise=False)
    assert measured.uncertainty_factor == 1.0
    planned = expanded(plan.to_dataframe("reflectors"), names, "U_x_um U_y_um U_z_um")
    made = 2e3 * expanded(measured.to_dataframe("targets"), names, "sigma_x_mm sigma_y_mm sigma_z_mm")
    assert made == pytest.approx(planned, rel=0.04)
    tasks = {
        "source": "-", "datum": names, "task": [{"name": n, "kind": "point", "targets": [n]} for n in names[:2]],
        "monte_carlo": {"max_trials": 10_000, "digits": 1, "coverage_probability": 0.9545},
    }  # fmt: skip
    worth = lt.uncertainty(recording, tasks)
    assert [r.expanded_uncertainty for r in worth.results] == pytest.approx(1e-3 * planned[:2].ravel(), rel=0.04)
    assert any("air" in warning for warning in worth.warnings)
    assert worth.results[0].hidden_errors or worth.results[1].hidden_errors
    parts = {part.source for part in worth.results[0].budget}
    assert not parts & {part.error_text for result in worth.results for part in result.hidden_errors}


def test_another_air_is_that_of_the_set_up(hall: Path) -> None:
    recording, _ = lt.simulate(hall / "plan" / "scenario.toml", seed=4)
    still = {"temperature_k": 0.0, "gradient_k_per_m": 0.0, "turbulence_um2_per_m3": 0.0}
    setup = recording.setup.model_copy(update={"air": type(recording.setup).model_validate({"air": still}).air})
    usual, exact = (lt.calibrate(r, advise=False) for r in (recording, recording.replace(setup=setup)))
    assert usual.air_text
    assert not exact.air_text
    assert np.all(usual.target_covariances[:, 0, 0] > exact.target_covariances[:, 0, 0])
    np.testing.assert_allclose(exact.target_covariances, exact.adjustment.target_covariances, rtol=1e-12)


@pytest.fixture(scope="module")
def plain() -> lt.Recording:
    """Recording of an uncorrected instrument in two faces."""
    return lt.simulate("paper-workshop-two-face", seed=11).recording


def test_a_rejected_fit_has_larger_standard_deviations_everywhere(plain: lt.Recording, tmp_path: Path) -> None:
    drift = plain.readings.copy()
    late = plain.station == 2
    drift[late, 2] += 3e-5 * np.sin(np.linspace(0.0, 9.0, late.sum()))
    calibration = lt.calibrate(plain.with_readings(drift), advise=False)
    assert calibration.uncertainty_factor == pytest.approx(calibration.fit.sigma0)
    assert calibration.uncertainty_factor > 1.1
    adjustment = calibration.adjustment
    np.testing.assert_allclose(
        calibration.target_covariances, calibration.fit.sigma0**2 * adjustment.target_covariances, rtol=1e-9
    )
    np.testing.assert_allclose(
        calibration.stations[1].sigma_position,
        calibration.fit.sigma0 * np.sqrt(np.diag(adjustment.pose_covariance[1])[:3]),
    )
    before, after = np.sqrt(np.diag(adjustment.covariance_of_all_instruments)), calibration.sigma.ravel()
    assert np.all(after > before)
    assert np.all(
        after
        <= np.minimum(calibration.fit.sigma0 * before, calibration.arrays.effective_prior_sigma.ravel()) * (1 + 1e-9)
    )
    lt.write(calibration, tmp_path)
    joint = read_coordinates(tmp_path / "targets.csv").covariance
    assert (tmp_path / COVARIANCE_FILE_NAME).is_file()
    np.testing.assert_allclose(joint[:3, :3], calibration.target_covariances[0], rtol=1e-5)
    assert "multiplied by sigma0" in str(calibration)
    assert lt.read(tmp_path).fit.sigma0 == pytest.approx(calibration.fit.sigma0)


def test_an_adjustment_says_that_the_instrument_is_still_in_its_coordinates(plain: lt.Recording) -> None:
    adjustment = lt.adjust(plain)
    assert adjustment.fit_with_constants is not None
    assert adjustment.fit_with_constants.p_value > 0.01 > adjustment.fit.p_value
    assert not adjustment.constants_included
    assert "the instrument constants were not estimated" in str(adjustment)
    corrected = lt.correct(plain, lt.calibrate(plain, advise=False))
    again = lt.adjust(corrected)
    assert again.fit_with_constants is None
    assert again.constants_included


def test_an_error_of_the_constants_is_no_outlier() -> None:
    """The collimation error of a steep sight was reported as an outlier, with the action to measure it again."""
    adjusted = lt.adjust(lt.simulate("paper-workshop-two-face", seed=21).recording)
    assert adjusted.fit_with_constants is not None and (adjusted.fit_with_constants.p_value or 0.0) > 0.01
    assert adjusted.outliers == ()
    assert "No reading is an outlier if the instrument constants are estimated." in adjusted.verdict.sentence


def test_a_rejected_calibration_corrects_nothing_unless_it_is_asked_to(plain: lt.Recording, tmp_path: Path) -> None:
    noise = random_stream(11, "rejected").standard_normal(plain.readings.shape) * 3.0 * plain.reading_sigmas()
    calibration = lt.calibrate(plain.with_readings(plain.readings + noise), advise=False)
    lt.write(calibration, tmp_path)
    for source in (calibration, tmp_path):
        with pytest.raises(RecordError, match=r"contradict its model \(sigma0 = .*give allow_rejected=True to use it"):
            lt.correct(plain, source)
        assert lt.correct(plain, source, allow_rejected=True).is_corrected


def test_constants_are_compared_without_the_rejected_readings() -> None:
    """Outliers that a robust adjustment rejects do not hide that the constants of the instrument are the reason."""
    recording, _ = lt.simulate("paper-workshop-two-face", seed=4)
    readings = recording.readings.copy()
    readings[[20, 77, 150], 0] += [2e-3, -1.5e-3, 1e-3]
    adjusted = lt.adjust(recording.with_readings(readings), robust=True)
    assert len(adjusted.outliers) == 3
    assert adjusted.fit_with_constants is not None and (adjusted.fit_with_constants.p_value or 0.0) > 0.01
