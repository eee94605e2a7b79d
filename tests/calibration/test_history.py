"""Calibrations over time: the tests hold their level, find a change, and the history improves a new calibration."""

import json
from datetime import date

import numpy as np
import pytest
from scipy import stats

from ltsim.adjustment.fieldcheck.setup_model import two_face_pairs
from ltsim.calibration.arrays import CalibrationArrays
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.calibration_series import CalibrationSeries
from ltsim.calibration.events import has_enough_steps_for_event_test, significant_parameter_steps
from ltsim.calibration.files import write_calibration
from ltsim.calibration.history import History
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.schema import FitEntry
from ltsim.cli.main import run
from ltsim.core.errors import RecordError
from ltsim.core.randomness import random_stream
from ltsim.physics.model.construction import ideal_construction, misalignment_construction
from ltsim.recordings import write

CONSTRUCTION = misalignment_construction()
SIZE = CONSTRUCTION.n_parameters
PRIOR = np.array([p.prior_sigma for p in CONSTRUCTION.parameters])
SILENT = 3
"""The first parameters of the synthetic calibrations are those their readings do not touch."""
FIT = FitEntry(chi2=1, dof=1, sigma0=1, p_value=0.5, iterations=1, status="")


def estimate(truth, design, rng, prior=PRIOR):
    """A calibration as an adjustment would give it: design rows of unit weight, priors centred at zero."""
    vector = design.T @ (design @ truth + rng.standard_normal(len(design)))
    covariance = np.linalg.inv(design.T @ design + np.diag(prior**-2))
    arrays = CalibrationArrays(CONSTRUCTION, ("",), (covariance @ vector)[None], prior[None], covariance)
    return Calibration.from_arrays(arrays, method="network", fit=FIT)


def designs(rng, count, strength=8.0):
    """Random designs that tell nothing of the first parameters and correlate the others."""
    rows = rng.standard_normal((count, 30, SIZE)) * strength / PRIOR / np.sqrt(30)
    rows[:, :, :SILENT] = 0.0
    rows[:, :, -1] = rows[:, :, -2] * PRIOR[-2] / PRIOR[-1] + 0.02 * rows[:, :, -1]
    return rows


def labelled(calibrations):
    return [(f"c{i}", c) for i, c in enumerate(calibrations)]


def test_an_unchanged_instrument_passes_at_the_declared_rate():
    joint, single, constant = [], [], []
    for trial in range(150):
        rng = random_stream(1, "unchanged", trial)
        truth = PRIOR * rng.standard_normal(SIZE)
        history = CalibrationSeries.from_labelled(labelled([estimate(truth, d, rng) for d in designs(rng, 3)]))
        change = history.change_between(0, 2)
        joint.append(change.p_value)
        single.append([p.p_value for p in change.parameters[SILENT + 1 :: 3]])
        constant.append(history.constancy_test().p_value)
        assert change.dof == history.constancy_test().dof / 2
    for values in (joint, np.ravel(single), constant):
        assert stats.kstest(np.ravel(values), "uniform").pvalue > 1e-3


def test_what_no_reading_touches_is_neither_changed_nor_counted():
    rng = random_stream(2, "silent")
    history = CalibrationSeries.from_labelled(labelled([estimate(np.zeros(SIZE), d, rng) for d in designs(rng, 2)]))
    change = history.change_between(0, 1)
    assert change.dof <= SIZE - SILENT
    assert [p.p_value for p in change.parameters[:SILENT]] == pytest.approx([1.0] * SILENT)
    assert history.constancy_test(0).dof == 0
    assert history.population.between_calibration_sigma[:SILENT] == pytest.approx(PRIOR[:SILENT])


def test_a_changed_parameter_is_detected_and_named():
    rng = random_stream(3, "changed")
    truth = PRIOR * rng.standard_normal(SIZE)
    later = truth.copy()
    later[5] += 3.0 * PRIOR[5]
    drawn = designs(rng, 4, strength=40.0)
    history = CalibrationSeries.from_labelled(
        labelled([estimate(t, d, rng) for t, d in zip((truth, truth, later, later), drawn, strict=True)])
    )
    assert [change.changed_parameters for change in history.successive_changes()] == [
        (),
        (CONSTRUCTION.parameter_names[5],),
        (),
    ]
    assert history.successive_changes()[1].p_value < 1e-10
    assert history.constancy_test(5).p_value < 1e-6
    assert history.constancy_test(6).p_value > 1e-3


@pytest.mark.long
def test_three_calibrations_do_not_look_more_similar_than_they_are():
    """The restricted likelihood: the spread about a mean that is found from the same calibrations, unbiased."""
    rng, ratios = random_stream(9, "few"), []
    for _ in range(40):
        mean, (design,) = rng.standard_normal(SIZE) * PRIOR, designs(rng, 1, strength=40.0)
        few = [estimate(mean + 0.5 * PRIOR * rng.standard_normal(SIZE), design, rng) for _ in range(3)]
        population = CalibrationSeries.from_labelled([(str(k), c) for k, c in enumerate(few)]).population
        ratios.append((population.between_calibration_sigma[SILENT:-2] / (0.5 * PRIOR[SILENT:-2])) ** 2)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)


def test_the_population_is_recovered_and_improves_a_new_calibration():
    rng = random_stream(4, "population")
    mean, spread = 0.5 * PRIOR * rng.standard_normal(SIZE), PRIOR * np.where(np.arange(SIZE) % 2, 0.5, 0.02)
    truths = mean + spread * rng.standard_normal((41, SIZE))
    calibrations = [estimate(t, d, rng) for t, d in zip(truths, designs(rng, 41), strict=True)]
    history = CalibrationSeries.from_labelled(labelled(calibrations[:40]))
    section = slice(SILENT, SIZE - 2)
    population = history.population
    assert np.abs((population.mean - mean) / PRIOR)[section] == pytest.approx(0.0, abs=0.25)
    assert population.between_calibration_sigma[section][1::2] / PRIOR[section][1::2] == pytest.approx(0.02, abs=0.1)
    assert population.between_calibration_sigma[section][::2] / PRIOR[section][::2] == pytest.approx(0.5, abs=0.25)
    errors = np.array([history.with_population_prior(c).estimates[0] - truths[40] for c in calibrations[40:]])
    alone = np.array([c.estimates[0] - truths[40] for c in calibrations[40:]])
    assert np.sum((errors / PRIOR)[:, section] ** 2) < 0.7 * np.sum((alone / PRIOR)[:, section] ** 2)


def test_json_holds_every_test_in_the_units_of_a_person():
    rng = random_stream(5, "json")
    history = CalibrationSeries.from_labelled(labelled([estimate(np.zeros(SIZE), d, rng) for d in designs(rng, 3)]))
    content = json.loads(History.from_series(history).text())
    assert content["format"] == "ltsim-history/1"
    assert [c["label"] for c in content["calibrations"]] == ["c0", "c1", "c2"]
    k = 4
    row, parameter = content["parameters"][k], CONSTRUCTION.parameters[k]
    assert row["sigmas"] == pytest.approx(history.sigma[:, k] / parameter.si_per_display_unit)
    assert content["change_since_first"]["chi2"] == pytest.approx(history.change_between(0, 2).chi2)


def walked(trial, *, blow=0.0):
    """Twelve calibrations of an instrument whose parameters move by half a prior sigma a day; one is hit on day 8."""
    rng = random_stream(6, "walk", trial)
    truths = PRIOR * rng.standard_normal(SIZE) + 0.5 * PRIOR * rng.standard_normal((12, SIZE))
    truths[8:, 6] += blow * PRIOR[6]
    return CalibrationSeries.from_labelled(
        labelled([estimate(t, d, rng) for t, d in zip(truths, designs(rng, 12, 40.0), strict=True)])
    )


def test_what_moves_from_day_to_day_is_no_event():
    """The joint test sees every step; hardly one in a hundred histories has an event that is none."""
    histories = [walked(trial) for trial in range(12)]
    assert all(change.p_value < 0.01 for change in histories[0].successive_changes())
    assert sum(bool(significant_parameter_steps(history)) for history in histories) <= 1  # two by chance: 0.6 %


def test_a_blow_stands_out_and_is_dated():
    for trial in range(2):
        history = walked(trial, blow=12.0)
        steps, size = significant_parameter_steps(history), PRIOR[6] / CONSTRUCTION.parameters[6].si_per_display_unit
        assert [(event.from_, event.name) for event in steps] == [("c7", CONSTRUCTION.parameter_names[6])]
        assert steps[0].difference == pytest.approx(12.0 * size, rel=0.25)
        assert steps[0].usual_step_sigma == pytest.approx(0.7 * size, rel=0.5)
        entry = History.from_series(history).events[0]
        assert (entry.from_, entry.to, entry.unit) == ("c7", "c8", CONSTRUCTION.parameters[6].unit)


DATES = ("01-01", "01-02", "01-04", "01-05", "01-06", "06-15", "06-16", "06-18", "06-19")


def wandered(trial, *, blow=0.0, dated=True):
    """Nine calibrations of an instrument that wanders by 0.3 prior sigmas a root day, 160 days apart once."""
    rng = random_stream(8, "wander", trial)
    days = np.diff([date.fromisoformat(f"2026-{d}").toordinal() for d in DATES])
    steps = 0.3 * np.sqrt(days)[:, None] * rng.standard_normal((len(days), SIZE))
    truths = PRIOR * np.cumsum(np.vstack([np.zeros(SIZE), steps]), axis=0)
    truths[7:, 6] += blow * PRIOR[6]
    named = labelled([estimate(t, d, rng) for t, d in zip(truths, designs(rng, len(DATES), 40.0), strict=True)])
    return CalibrationSeries.from_labelled(named, dates=[f"2026-{d}" for d in DATES] if dated else None)


def test_half_a_year_may_move_what_a_day_may_not():
    """Without dates the long step is taken for an event; with them it is one as often as it should be."""
    undated = sum(bool(significant_parameter_steps(wandered(trial, dated=False))) for trial in range(8))
    dated = sum(bool(significant_parameter_steps(wandered(trial))) for trial in range(8))
    assert undated >= 6
    assert dated <= 1


def test_a_blow_between_two_days_stands_out_of_a_wandering_instrument():
    steps = significant_parameter_steps(wandered(0, blow=12.0))
    assert [(event.from_, event.name) for event in steps] == [("c6", CONSTRUCTION.parameter_names[6])]


@pytest.mark.parametrize(
    ("dates", "words"),
    [
        (["2026-01-01"], "there are 1 dates for 2 calibrations"),
        (["2026-01-02", "2026-01-01"], r"c0 \(2026-01-02\) is listed before c1 .* in the order of time"),
        (["1.2.2026", "2.2.2026"], "expected dates such as 2026-05-31"),
    ],
)
def test_wrong_dates_get_a_sentence(dates, words):
    rng = random_stream(7, "few")
    named = labelled([estimate(np.zeros(SIZE), d, rng) for d in designs(rng, 2)])
    with pytest.raises(RecordError, match=words):
        CalibrationSeries.from_labelled(named, dates=dates)


def test_few_calibrations_tell_no_event():
    rng = random_stream(7, "few")
    history = CalibrationSeries.from_labelled(labelled([estimate(np.zeros(SIZE), d, rng) for d in designs(rng, 3)]))
    assert not has_enough_steps_for_event_test(history)
    assert not significant_parameter_steps(history)


def test_a_single_calibration_is_refused():
    rng = random_stream(6, "refused")
    calibration = estimate(np.zeros(SIZE), designs(rng, 1)[0], rng)
    with pytest.raises(RecordError, match="at least two"):
        CalibrationSeries.from_labelled([("a", calibration)])


def test_a_parameter_without_uncertainty_is_refused():
    rng = random_stream(6, "refused")
    calibration = estimate(np.zeros(SIZE), designs(rng, 1)[0], rng)
    sure = calibration.with_changes(covariance=np.diag(np.r_[0.0, np.diag(calibration.covariance)[1:]]))
    with pytest.raises(RecordError, match="no uncertainty of range-offset"):
        CalibrationSeries.from_labelled([("a", calibration), ("b", sure)])


@pytest.fixture(scope="module")
def before_and_after(make):
    """A recording, one of the same instrument, and one after its beam tilt has changed."""
    truth = 0.3 * PRIOR * random_stream(7, "truth").standard_normal(SIZE)
    knocked = truth.copy()
    knocked[CONSTRUCTION.parameter_index("beam-tilt")] += 10e-6
    return [make(v, faces=(1, 2), trial=i) for i, v in enumerate((truth, truth, knocked))]


def test_the_command_follows_recordings_and_calibrations(before_and_after, tmp_path, capsys):
    first, second, third = before_and_after
    write_calibration(calibrate_network(first, recommend_measurements=False), tmp_path / "january")
    write(second, tmp_path / "may")
    write(third, tmp_path / "september")
    paths = [str(tmp_path / name) for name in ("january", "may", "september")]
    assert run(["history", *paths[:2], "--fail-on-change", "--out", str(tmp_path / "same")]) == 0
    assert "shows no change since the first" in capsys.readouterr().out
    assert run(["history", *paths, "--fail-on-change", "--json"]) == 1
    content = json.loads(capsys.readouterr().out)
    assert "beam-tilt" in content["changes"][1]["changed_parameters"]
    assert content["changes"][0]["changed_parameters"] == []
    assert (tmp_path / "same" / "history.svg").read_text().startswith("<?xml")
    assert run(["history", paths[0]]) == 2
    assert "at least two" in capsys.readouterr().err


def test_the_command_takes_each_set_up_by_itself(before_and_after, tmp_path, capsys):
    write(before_and_after[0], tmp_path / "recording")
    assert run(["history", str(tmp_path / "recording"), "--each-set-up", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert len(content["calibrations"]) == len(before_and_after[0].stations)


def test_half_differences_are_those_of_the_parameters(make):
    values = np.zeros(SIZE)
    values[CONSTRUCTION.parameter_index("vertical-index")] = 12e-6
    values[CONSTRUCTION.parameter_index("transit-offset")] = 20e-6
    recording = make(values, faces=(1, 2), noise=0.0)
    raw = two_face_pairs(recording)
    assert np.abs(raw.half_differences[:, 2]) == pytest.approx(12e-6, abs=12e-6)
    assert raw.half_differences[:, 0] == pytest.approx(-20e-6 * np.cos(raw.mean_front_face_readings[:, 2]), rel=1e-3)
    assert two_face_pairs(recording, CONSTRUCTION, values).rms_half_differences == pytest.approx(0.0, abs=1e-10)
    assert two_face_pairs(recording, ideal_construction()).rms_half_differences == pytest.approx(
        raw.rms_half_differences
    )
