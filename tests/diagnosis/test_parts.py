"""Parts of the diagnosis by themselves, each on a network whose answer is known."""

from __future__ import annotations

import re
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.remedies.next_measurement import MIN_DECISIVE_CHI2
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.assembly import _reported_findings
from ltsim.diagnosis.detectability import separating_measurement_sentence
from ltsim.diagnosis.diagnose import log_bayes_factor_of_refits
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.evidence import observables_changed_by_effect
from ltsim.diagnosis.findings import SelectedModelFit
from ltsim.diagnosis.global_test import GlobalTestResult
from ltsim.diagnosis.hypotheses import EffectModel
from ltsim.diagnosis.schema import Finding, FindingEvidence, FindingScope, Misfit
from ltsim.diagnosis.sentences import law_sentence
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.physics.model.construction import misalignment_construction
from tests.networks import network, with_effect

# --- evidence ---------------------------------------------------------------------------------------------------------


def test_an_effect_is_reported_in_the_observables_on_which_it_acts_and_in_which_it_shows() -> None:
    use = np.array([[True, True, False], [True, True, True]])
    everywhere = np.ones(5)
    assert observables_changed_by_effect(use, everywhere, np.array([3.0, 0.9, 0.0, 0.0, 0.0])) == ("distance",)
    assert observables_changed_by_effect(use, everywhere, np.array([3.0, 1.1, 0.0, 0.0, 0.0])) == (
        "distance",
        "azimuth",
    )
    assert observables_changed_by_effect(use, everywhere, everywhere) == ()
    assert observables_changed_by_effect(use, np.array([1.0, 0.0, 1.0, 0.0, 1.0]), everywhere) == (
        "distance",
        "elevation",
    )


# --- separate ---------------------------------------------------------------------------------------------------------


def test_what_is_no_question_gets_no_measurement() -> None:
    adjustment = adjust(network(faces=2, seed=6)[0], misalignment_construction())
    assert separating_measurement_sentence(adjustment, "range-step", [], ()) == ""
    assert separating_measurement_sentence(adjustment, "range-step", ["unknown"], ()) == ""
    assert separating_measurement_sentence(adjustment, "range-step", ["station-noise"], ()) == ""
    assert separating_measurement_sentence(adjustment, "station-noise", ["range-step"], ()) == ""


def test_a_bump_and_a_settling_are_distinguished_by_another_order_of_the_work() -> None:
    settled = StationSettling(("S3",), time_constant=480.0)
    adjustment = adjust(with_effect(settled, [8e-6, -5e-6, 5e-6]), misalignment_construction())
    advice = separating_measurement_sentence(adjustment, "station-settling", ["station-bump"], ())
    assert advice.startswith("measure every station's targets again in the reverse order: the expected chi-square")
    before, after = map(float, re.findall(r"from (\d+) to (\d+)", advice)[0])
    assert before < MIN_DECISIVE_CHI2 < after


# --- global_test ----------------------------------------------------------------------------------------------------


def test_p_values_are_ranks_among_simulated_recordings_and_never_zero() -> None:
    null = random_stream(3, "null").permutation(np.arange(1000.0))
    result = GlobalTestResult(0.0, 1.0, null)
    assert result.critical_value(0.05) == pytest.approx(949.05)
    assert result.p_value_of(-1.0) == 1.0
    assert result.p_value_of(500.0) == pytest.approx(501 / 1001)
    assert result.p_value_of(999.0) == pytest.approx(2 / 1001)
    assert result.p_value_of(1e4) == result.p_value_of(999.5) == pytest.approx(1 / 1001)


@pytest.mark.parametrize(
    ("law", "where", "text"),
    [
        (
            "vertical index follows hall_c",
            FindingScope(instruments=("B",), covariates=("hall_c",)),
            "of instrument B follows",
        ),
        ("vertical index differs", FindingScope(stations=("S4",)), "vertical index at station S4 differs"),
    ],
)
def test_the_place_of_a_law_is_next_to_its_response(law, where, text):
    assert text in law_sentence(where, [], 0.9, law)


# --- what is told -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Set:
    """Stands for what explains a recording: its members by name, with a chance each; later letters explain more."""

    members: tuple[str, ...]
    chances: dict[str, float]
    has_test_findings: bool

    @property
    def model(self) -> SimpleNamespace:
        return SimpleNamespace(hypotheses=[SimpleNamespace(effect_key=name) for name in self.members])

    @property
    def squared_residual_decreases(self) -> list[np.ndarray]:
        return [np.array([float(ord(name))]) for name in self.members]

    def p_real(self, member: int) -> float:
        return self.chances[self.members[member]]

    def p_cause(self, member: int) -> float:
        return {"d": 0.999}.get(self.members[member], 0.9)


def test_a_doubtful_finding_is_modelled_and_reported_only_where_nothing_else_is() -> None:
    untold = SelectedModelFit.unreported_effect_keys.func
    assert untold(Set(("a", "b", "c"), {"a": 0.9, "b": 0.1, "c": 0.2}, has_test_findings=True)) == ("b", "c")
    assert untold(Set(("a", "b", "c"), {"a": 0.9, "b": 0.1, "c": 0.2}, has_test_findings=False)) == ("b",)
    assert untold(Set(("b",), {"b": 0.1}, has_test_findings=False)) == ()
    assert untold(Set(("b", "d"), {"b": 0.1, "d": 0.1}, has_test_findings=True)) == ("b",)


def test_a_second_effect_that_certainly_exists_is_reported_whatever_its_name() -> None:
    untold = SelectedModelFit.unreported_effect_keys.func
    assert untold(Set(("d", "e"), {"d": 0.1, "e": 0.9}, has_test_findings=False)) == ()
    assert untold(Set(("d", "e"), {"d": 0.0, "e": 0.9}, has_test_findings=False)) == ("d",)


def finding(effect: str, chi2_drop: float, probability: float) -> Finding:
    return Finding(effect=effect, evidence=FindingEvidence(chi2_drop=chi2_drop, parameters=1, probability=probability))


def test_a_certain_effect_of_uncertain_form_is_reported_next_to_noise() -> None:
    """It was left out where a change of the noise, or a wrong reading, was probable."""
    effect, noise = finding("unknown", 90.0, 0.1), finding("station-noise", 100.0, 0.9)
    doubtful, blunder = finding("turbulence", 20.0, 0.2), finding("outlier", 200.0, 0.9)
    assert _reported_findings([], [effect], [noise, doubtful]) == [noise, effect]
    assert _reported_findings([blunder], [effect], [doubtful]) == [blunder, effect]
    assert _reported_findings([], [], [doubtful]) == [doubtful]
    assert _reported_findings([blunder], [], [doubtful]) == [blunder]


def cause(name: str, coefficients: int) -> SimpleNamespace:
    """A hypothesis of a catalogue effect with coefficients of plausible size 1."""
    return SimpleNamespace(name=name, is_catalogued=True, log_prior=-3.0, plausible_sizes=np.ones(coefficients))


def test_a_member_with_many_coefficients_needs_more_than_its_chi_square() -> None:
    """Ten coefficients that lower chi-square by 16: the evidence, with its Occam factor, is against them."""
    basis = np.linalg.qr(random_stream(5, "support").standard_normal((60, 11)))[0]
    residual = 8.0 * basis[:, 0] + np.sqrt(1.6) * basis[:, 1:].sum(axis=1)
    members, parts = (cause("a", 1), cause("b", 10)), (10.0 * basis[:, :1], 100.0 * basis[:, 1:])
    norms = tuple(np.linalg.norm(part, axis=0) for part in parts)
    model, reduced = (
        EffectModel(members, parts, norms, residual),
        EffectModel(members[:1], parts[:1], norms[:1], residual),
    )
    drop = float(reduced.residual @ reduced.residual - model.residual @ model.residual)
    assert drop == pytest.approx(16.0)
    assert 0.5 * drop + members[1].log_prior > 0.0
    log_factor = log_bayes_factor_of_refits(model, reduced, drop)
    assert log_factor < 0.0
    assert log_bayes_factor_of_refits(model, reduced, drop + 10.0) == pytest.approx(log_factor + 5.0)


@pytest.mark.parametrize("after", [1.0, 1.2])
def test_the_held_out_error_is_printed_where_a_search_was_repeated(after: float) -> None:
    """Without a shift of the readings nothing is predicted anew: both errors are the same number."""
    before, modelled = Misfit(chi2=120.0, dof=80, held_out_rms=1.2), Misfit(chi2=80.0, dof=80, held_out_rms=after)
    result = SimpleNamespace(
        verdict="mismatch", summary="", findings=(None,), fit=SimpleNamespace(before=before, after=modelled)
    )
    printed = "\n".join(Diagnosis._summary_lines(result))
    assert ("held-out error" in printed) == (after != 1.2)
