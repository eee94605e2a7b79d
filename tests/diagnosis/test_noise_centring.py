"""Centring errors of all targets in a diagnosis: reflectors centred anew at each occupation, and none."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.randomness import random_stream
from ltsim.core.units import MICROMETRE, MILLIMETRE
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.noise_centring import log_evidence_and_centring_hypotheses, with_declared_centring
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.physics.effects.range_cyclic import RangeCyclic
from ltsim.physics.laws.variance import CentringVariance
from ltsim.recordings.recording import Recording
from tests.networks import network

SIGMA = 0.15 * MILLIMETRE


def centred_anew(seed: int, sigma: float) -> Recording:
    """Four stations, two faces; each reflector is centred anew after the second station, displaced by `sigma` [m]."""
    recording, _ = network(seed=seed, stations=4, faces=2)
    period = recording.station // 2
    labels = {"target_setup": tuple(f"P{p}" for p in period.tolist())}
    displacement = sigma * random_stream(seed, "centring").standard_normal((2, len(recording.targets), 3))
    change = reading_change_by_displacement(adjust(recording).sightings, displacement[period, recording.target])
    return recording.replace(readings=recording.readings + change, labels=labels)


def space_of(recording: Recording) -> ResidualSpace:
    return ResidualSpace.from_adjustment(adjust(recording))


def test_the_variance_component_of_the_occupations() -> None:
    recording = centred_anew(11, SIGMA)
    ((gain, hypothesis),) = log_evidence_and_centring_hypotheses(space_of(recording))
    assert gain > 1000.0
    assert hypothesis.sizes[0] == pytest.approx(SIGMA, rel=0.25)
    declared = with_declared_centring(recording, [hypothesis])
    assert declared.setup.centring[0].sigma_mm * MILLIMETRE == pytest.approx(hypothesis.sizes[0])
    assert adjust(declared).sigma0 == pytest.approx(1.0, abs=0.1)
    assert log_evidence_and_centring_hypotheses(space_of(declared)) == []


def test_centring_errors_do_not_absorb_an_effect_in_the_model() -> None:
    """With the effect in the model, the estimate is that of a recording without the effect."""
    recording, effect = centred_anew(14, SIGMA), RangeCyclic()
    size = np.array([2000.0, 0.0]) * MICROMETRE
    shifted = recording.with_readings(recording.readings + effect.reading_change(adjust(recording).sightings, size))
    state = SelectionState.from_adjustment(adjust(shifted), adjust(shifted).problem.is_used_reading, 0, None)
    ((_, hypothesis),) = log_evidence_and_centring_hypotheses(state.residual_space)
    assert hypothesis.sizes[0] > 2.0 * SIGMA
    state = state.with_noise_hypothesis(hypothesis, [effect])
    assert state.selected_noise_hypotheses[0].sizes[0] == pytest.approx(SIGMA, rel=0.25)


def test_no_centring_errors_without_displacements_or_occupations() -> None:
    clean = centred_anew(12, 0.0)
    ((gain, _),) = log_evidence_and_centring_hypotheses(space_of(clean))
    assert gain < 0.0
    assert log_evidence_and_centring_hypotheses(space_of(clean.replace(labels={}))) == []
    once = clean.replace(labels={"target_setup": ("P",) * len(clean)})
    assert log_evidence_and_centring_hypotheses(space_of(once)) == []


def test_a_diagnosis_reports_centring_errors_and_nothing_else() -> None:
    recording = centred_anew(13, SIGMA)
    diagnosis = diagnose(recording.select(recording.target % 2 == 0))
    (finding,) = diagnosis.findings
    assert finding.formula == CentringVariance(occupation_grouping="target_setup").text
    assert finding.sentence.startswith("Centring errors: reflectors that are centred anew at each occupation")
    assert finding.parameters[0].value == pytest.approx(0.15, rel=0.25)
    assert diagnosis.final_adjustment.sigma0 == pytest.approx(1.0, abs=0.1)
    assert np.isfinite(diagnosis.final_adjustment.target_covariances).all()


def repeated(seed: int, sigma: float) -> Recording:
    """Three stations, two rounds in one face; at each set-up each reflector is displaced by `sigma` [m]."""
    recording, _ = network(seed=seed, stations=3, repeats=2)
    displacement = sigma * random_stream(seed, "centring").standard_normal((3, len(recording.targets), 3))
    change = reading_change_by_displacement(
        adjust(recording).sightings, displacement[recording.station, recording.target]
    )
    return recording.with_readings(recording.readings + change)


@pytest.mark.long
def test_a_diagnosis_reports_errors_that_repeats_share_in_place_of_curves_at_each_set_up() -> None:
    recording = repeated(14, 0.02 * MILLIMETRE)
    diagnosis = diagnose(recording)
    (finding,) = diagnosis.findings
    assert finding.formula == CentringVariance(occupation_grouping="station").text
    assert finding.sentence.startswith("Repeated pointings of a target from one set-up have common errors of 0.0")
    assert finding.parameters[0].value == pytest.approx(0.02, rel=0.2)
    assert diagnosis.final_adjustment.sigma0 == pytest.approx(1.0, abs=0.1)


def test_displacements_at_each_set_up_need_repetitions_in_a_face() -> None:
    recording, _ = network(seed=15, stations=4, faces=2)
    assert log_evidence_and_centring_hypotheses(space_of(recording)) == []
    ((gain, _),) = log_evidence_and_centring_hypotheses(space_of(repeated(15, 0.0)))
    assert gain < 0.0
    ((gain, hypothesis),) = log_evidence_and_centring_hypotheses(space_of(repeated(15, 0.02 * MILLIMETRE)))
    assert gain > 50.0
    assert hypothesis.sizes[0] == pytest.approx(0.02 * MILLIMETRE, rel=0.2)


@pytest.mark.long
def test_a_law_in_repeated_rounds_is_no_centring_error() -> None:
    recording, _ = network(seed=16, stations=3, repeats=2)
    wave = np.sin(3.0 * recording.readings[:, 1])
    changed = recording.readings.copy()
    changed[:, 0] += 0.02 * MILLIMETRE * wave
    diagnosis = diagnose(recording.with_readings(changed))
    assert [f.formula for f in diagnosis.findings] and "azimuth" in diagnosis.findings[0].sentence
    assert not any("share errors" in f.sentence for f in diagnosis.findings)
