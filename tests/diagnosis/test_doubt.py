"""What comes before a law: wrong readings, noise that is not as declared; and a cause that nobody listed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.identification import identify_causes
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.randomness import random_stream
from ltsim.core.units import ARCSECOND
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.evidence import log_bayes_factor_of_discrepancy, log_evidence_of_wrong_readings
from ltsim.diagnosis.findings import SelectedModelFit
from ltsim.diagnosis.global_test import run_global_test
from ltsim.diagnosis.hypotheses import Hypothesis
from ltsim.diagnosis.model_selection import select_noise_and_effects
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.preprocessing import adjustment_without_blunders, revised_error_mask, single_error_mask
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.physics.effects import find_effect
from ltsim.physics.model.construction import declared_construction, misalignment_construction
from tests.diagnosis.test_diagnose import concealing, workshop
from tests.networks import network


def changed(recording, row, column, sigmas):
    """A recording with one reading that is off."""
    readings = recording.readings.copy()
    readings[row, column] += sigmas * recording.reading_sigmas()[row, column]
    return recording.with_readings(readings)


def space_of(recording):
    return ResidualSpace.from_adjustment(adjust(recording, misalignment_construction()))


@pytest.mark.parametrize(
    ("row", "column"), [(40, 0), *(pytest.param(r, c, marks=pytest.mark.long) for r, c in ((91, 1), (150, 2)))]
)
def test_a_single_wrong_reading_is_excluded_and_reported_before_any_law(row, column):
    recording = changed(workshop(2)[0], row, column, 15.0)
    space = space_of(recording)
    at = np.flatnonzero(np.flatnonzero(space.is_used_reading) == 3 * row + column)
    redundancy = float(space.redundancy[at][0])
    selection = identify_causes(recording, misalignment_construction())
    assert selection is not None
    assert np.argwhere(single_error_mask(selection.fit)).tolist() == [[row, column]]
    diagnosis = diagnose(recording)
    (finding,) = diagnosis.findings
    assert finding.effect == "outlier"
    assert finding.where.stations == (recording.stations[recording.station[row]],)
    assert finding.where.targets == (recording.targets[recording.target[row]],)
    assert finding.where.observables == (("distance", "azimuth", "elevation")[column],)
    (size,) = finding.parameters
    unit = 1e-3 if column == 0 else ARCSECOND
    assert size.value * unit == pytest.approx(15.0 * recording.reading_sigmas()[row, column], rel=0.25)
    assert size.sigma * unit == pytest.approx(recording.reading_sigmas()[row, column] / np.sqrt(redundancy), rel=1e-3)
    change = diagnosis.modelled_reading_change(recording)
    assert change[row, column] == pytest.approx(size.value * unit, rel=0.01) and np.count_nonzero(change) == 1
    assert finding.evidence.chi2_drop == pytest.approx((size.value / size.sigma) ** 2)
    assert finding.evidence.chi2_drop == pytest.approx(
        float(space.whitened_residuals[at][0]) ** 2 / redundancy, rel=0.01
    )


def test_a_wrong_reading_is_not_counted_again_in_the_readings_that_it_distorts():
    space = space_of(workshop(2)[0])
    row = int(np.argmax(space.redundancy[: int(space.is_used_reading.sum())] < 0.5))
    unit = np.zeros(space.n_equations)
    unit[row] = 1.0
    column = space.project(unit)
    no_effects = np.zeros((space.n_equations, 0))
    reading_evidence = log_evidence_of_wrong_readings(space, 60.0 * column, no_effects, 0.0)
    by_chi2 = 0.5 * 60.0**2 * column[row]
    assert by_chi2 - 20.0 < reading_evidence < by_chi2


def test_wrong_readings_explain_no_more_than_the_chi_square():
    """A station bumped by 1 mm was called several wrong readings, and the targets were off by 192 um."""
    space = space_of(workshop(2)[0])
    rows = int(space.is_used_reading.sum())
    residual = space.project(np.where(np.arange(space.n_equations) < rows // 4, 500.0, 0.0))
    evidence = log_evidence_of_wrong_readings(space, residual, np.zeros((space.n_equations, 0)), 0.0)
    assert 0.0 < evidence < 0.5 * float(residual @ residual) - 5.0 * (rows // 4)


@pytest.mark.parametrize(("sigmas", "is_error"), [(7.0, False), (40.0, True)])
def test_an_outlier_of_a_long_sight_is_no_gross_error_by_its_size_alone(sigmas, is_error):
    """In a hall 200 times as large, an angle off by a few standard deviations displaces its target by centimetres."""
    recording, _ = network(seed=4)
    readings = recording.readings * [200.0, 1.0, 1.0]
    large = recording.replace(readings=readings, setup=recording.setup.model_copy(update={"gauge": None}))
    selection = identify_causes(changed(large, 40, 1, sigmas), misalignment_construction())
    assert selection is not None
    assert selection.fit.is_gross_reading[40, 1]
    assert bool(single_error_mask(selection.fit)[40, 1]) == is_error


def test_outliers_share_their_place_with_those_that_are_small():
    """Three readings of one observable at a station may follow an effect, of which two are far out."""
    recording = network(seed=4)[0]
    rows = np.flatnonzero(recording.station == 2)[[2, 9, 16]]
    for row, sigmas in zip(rows, (14.0, -14.0, 7.0), strict=True):
        recording = changed(recording, row, 1, sigmas)
    selection = identify_causes(recording, misalignment_construction())
    assert selection is not None
    assert selection.fit.is_outlier[rows, 1].all()
    assert not single_error_mask(selection.fit).any()


@pytest.mark.long
@pytest.mark.parametrize("last", [True, False])
def test_a_wrong_reading_of_a_last_pointing_may_be_a_target_that_moved(last):
    recording, _ = workshop(2)
    rows = np.flatnonzero(recording.target == recording.target[40])
    row = int(rows[np.argsort(recording.time[rows])[-1 if last else -2]])
    (finding,) = diagnose(changed(recording, row, 0, 15.0)).findings
    assert [e.effect for e in finding.equivalents] == ["target-moved"] * last
    assert finding.evidence.probability + sum(e.probability for e in finding.equivalents) <= 1.0


def test_a_target_that_moved_is_no_wrong_reading():
    """Several readings of it are off, however large each is."""
    recording, _ = concealing("target-moved", 3, [1e-5, 1e-5, -1e-5], targets=("T07",), time=2500.0)
    selection = identify_causes(recording, misalignment_construction())
    assert selection is not None
    assert not single_error_mask(selection.fit).any()


@pytest.mark.long
@pytest.mark.parametrize("factors", [(0.3, 0.4, 0.5), (3.0, 2.0, 4.0)])
def test_wrongly_declared_noise_is_reported_as_such_and_nothing_else(factors):
    """By a different factor in each observable."""
    recording, _ = workshop(4)
    adjustment = adjust(recording, misalignment_construction())
    expected = adjustment.problem.model.predict(adjustment.state)
    noisy = recording.with_readings(expected + np.array(factors) * (recording.readings - expected))
    assert [f.effect for f in diagnose(noisy).findings] == ["noise-level"]


@pytest.mark.long
def test_noise_that_differs_between_targets_is_a_single_finding():
    recording, _ = workshop(5)
    times = np.exp(random_stream(5, "poses").normal(0.0, 1.2, len(recording.targets)))[recording.target]
    more = (
        random_stream(6, "scatter").standard_normal((len(recording), 3)) * recording.reading_sigmas() * times[:, None]
    )
    findings = diagnose(recording.with_readings(recording.readings + more)).findings
    assert findings[0].effect == "unknown"
    assert findings[0].driver == "target"
    assert len(findings) <= 2


def test_a_weak_effect_has_an_uncertain_cause_and_a_strong_effect_a_certain_cause():
    recording, _ = workshop(1)
    space = space_of(recording)
    rows = int(space.is_used_reading.sum())
    redundancy = space.redundancy
    rng = random_stream(8, "likeness")
    law = rng.standard_normal(space.n_equations)
    law[rows:] = 0.0
    law /= np.linalg.norm(law)
    weak, strong = (
        log_bayes_factor_of_discrepancy(space, size * law, space.whitened_residuals, redundancy)
        for size in (8.0, 400.0)
    )
    assert -1.0 < weak < 1.0  # as likely as the law itself
    assert strong < -4.0
    wrong = space.whitened_residuals + np.append(1.5 * rng.standard_normal(rows), np.zeros(space.n_equations - rows))
    assert log_bayes_factor_of_discrepancy(space, 40.0 * law, wrong, redundancy) > 20.0  # something else is left behind


def test_a_name_is_less_certain_than_the_place_that_the_readings_show():
    recording, _ = concealing("range-cyclic", 3, [1e-6, 1e-6], wavelength=0.31)
    (finding,) = diagnose(recording).findings
    assert finding.effect == "range-cyclic"
    assert 0.7 < finding.evidence.probability < 0.95
    assert "unknown" in [other.effect for other in finding.equivalents]


def test_a_reference_length_that_is_wrong_is_reported_as_such_and_not_as_physics():
    recording, _ = workshop(2)
    first, *others = recording.gauge.distance
    wrong = first.model_copy(update={"length_mm": first.length_mm + 0.3})
    gauge = recording.gauge.model_copy(update={"distance": (wrong, *others)})
    changed_ = recording.replace(setup=recording.setup.model_copy(update={"gauge": gauge}))
    diagnosis = diagnose(changed_)
    assert diagnosis.verdict == "mismatch"
    assert [f.carrier for f in diagnosis.findings] == ["reference length"]
    assert set(diagnosis.findings[0].where.targets) == {first.from_, first.to}
    (size,) = diagnosis.findings[0].parameters
    assert size.value == pytest.approx(0.3, abs=4 * size.sigma + 0.02)


@pytest.mark.long
def test_nothing_unlikely_is_reported_next_to_anything_else(monkeypatch):
    """Neither a shift nor a change of the noise; alone it is."""
    recording, _ = concealing("range-cyclic", 3, [1e-6, 1e-6], wavelength=0.31)
    (alone,) = diagnose(recording).findings
    unlikely = alone.model_copy(update={"evidence": alone.evidence.model_copy(update={"probability": 0.4})})
    noisy = NoiseHypothesis(
        "noise-level", find_effect("noise-level")(), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1), 9.0, 5.0, 0.4
    )

    def with_noise(*arguments):
        state, model = select_noise_and_effects(*arguments)
        return replace(state, selected_noise_hypotheses=(noisy,)), model

    monkeypatch.setattr("ltsim.diagnosis.diagnose.select_noise_and_effects", with_noise)
    findings = diagnose(recording).findings
    assert [f.effect for f in findings] == ["range-cyclic"]
    monkeypatch.setattr(SelectedModelFit, "finding_of_effect", lambda *_: unlikely)
    assert diagnose(recording).findings


@pytest.mark.long
def test_noise_that_differs_between_set_ups_is_a_single_finding():
    """Three of five set-ups are restless, each in another observable: no single one explains the others."""
    recording, _ = network(repeats=2, seed=9)
    sigma = recording.reading_sigmas().copy()
    louder = np.ones_like(sigma)
    for station, column in ((1, 0), (2, 1), (4, 2)):
        louder[recording.station == station, column] = 5.0
    more = np.sqrt(louder**2 - 1.0) * sigma * random_stream(5, "set-ups").standard_normal(sigma.shape)
    findings = diagnose(recording.with_readings(recording.readings + more)).findings
    (first,) = findings
    assert (first.carrier, first.driver) == ("noise", "station")
    assert "from set-up to set-up, separately for each observable" in first.sentence
    names = {recording.stations[i] for i in (1, 2, 4)}
    assert {e.name.partition(" at ")[2] for e in first.parameters[:3]} == names


@pytest.mark.long
def test_nothing_without_a_size_is_reported_next_to_something_else():
    """A plume that fits the way of one station by chance has no temperature: the wrong reading alone is told."""
    recording = changed(workshop(2)[0], 40, 0, 15.0)
    case = SelectionState.from_adjustment(
        adjust(recording, misalignment_construction()), np.ones((len(recording), 3), dtype=bool), 0
    )
    plume = find_effect("heat-plume")(("S2",), (), (0.0, 0.0, 0.4), 0.2)
    members = [Hypothesis(plume, -9.0, 5.0, "heat-plume")]
    model = case.searcher.model_with(members)
    explained = SelectedModelFit(
        case,
        run_global_test(case.searcher, case.noise_hypotheses),
        model,
        case.refit(model.effects, case.reading_sigmas),
    )
    (reported,) = (
        estimate for estimate in explained.refit.estimates[0] if estimate.parameter.name == "plume-temperature"
    )
    assert abs(reported.value) < 2.0 * reported.sigma
    assert explained.p_real(0) == 0.0


@pytest.mark.long
def test_a_finding_that_few_readings_carry_names_them():
    recording = changed(workshop(2)[0], 40, 0, 7.5)
    (finding,) = diagnose(recording).findings
    station, target = recording.stations[recording.station[40]], recording.targets[recording.target[40]]
    assert (
        f"Most of the decrease of chi-square is in the distance from {station} to {target} (row 41)."
        in finding.sentence
    )


@pytest.mark.long
def test_every_probable_finding_is_reported():
    """A wrong reading is reported beside larger noise of all readings."""
    recording, _ = workshop(4)
    more = 2.5 * recording.reading_sigmas() * random_stream(5, "louder").standard_normal((len(recording), 3))
    recording = changed(recording.with_readings(recording.readings + more), 40, 0, 100.0)
    both = diagnose(recording)
    assert {f.effect for f in both.findings} == {"outlier", "noise-level"}
    assert both.fit.after.chi2 < 0.5 * both.fit.before.chi2


@pytest.mark.parametrize("sigmas", [7.5, -5.5])
def test_an_outlier_among_readings_with_small_noise_is_a_single_error(sigmas: float) -> None:
    """Distances with 0.4 times the declared noise, and a single wrong azimuth: only noise was reported."""
    recording = network(faces=2, seed=23)[0]
    readings = recording.readings.copy()
    readings[:, 0] -= 0.65 * np.nan_to_num(adjust(recording).residuals[:, 0])
    readings[20, 1] += sigmas * recording.reading_sigmas()[20, 1]
    recording = recording.with_readings(readings)
    selection = identify_causes(recording)
    assert selection is not None
    baseline, is_used, _ = adjustment_without_blunders(recording, declared_construction(recording), selection)
    assert is_used.all()  # an effect may explain it
    assert np.argwhere(revised_error_mask(selection.fit, baseline, ~is_used)).tolist() == [[20, 1]]
