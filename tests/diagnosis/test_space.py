"""Panels of laws and cards: what is scored at once is what each law is worth alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import LOG_PRIOR_OF_EFFECT_SIZES, RELATIVE_EFFECT_SIZES, log_evidence, log_sum_exp
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.catalogue_designs import CatalogueDesigns, catalogue_candidate_effects
from ltsim.diagnosis.evidence import coefficient_posterior, log_evidence_of_coefficients, log_positivity_factor
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import UNCERTAIN_CHI2_FRACTION_OF_LAW, EffectModel, Hypothesis, HypothesisRanking
from ltsim.diagnosis.law_batch import indices_of_largest
from ltsim.diagnosis.law_search_space import law_batches
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.null_ensemble import NullEnsemble
from ltsim.diagnosis.prior import (
    PRIOR_PROBABILITY_BY_CAUSE_CLASS,
    PRIOR_PROBABILITY_BY_PLACE_KIND,
    PRIOR_PROBABILITY_BY_RESPONSE_KIND,
    PRIOR_PROBABILITY_BY_RESPONSE_KIND_AT_TARGETS,
    prior_table_rows,
)
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import CONSTANT_REGRESSOR, scalar_regressor
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from ltsim.physics.model.construction import misalignment_construction
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def space() -> ResidualSpace:
    recording, _ = network(faces=2, values=drawn(misalignment_construction(), 1), seed=1)
    return ResidualSpace.from_adjustment(adjust(recording, misalignment_construction()))


@pytest.fixture(scope="module")
def made(space):
    """All panels, scored once."""
    probe = NullEnsemble.from_residual_space(space, 0, 300)
    batches = law_batches(space)
    return probe, batches, [panel.best_laws_and_log_total_evidence(probe) for panel in batches]


def alone(space: ResidualSpace, law: CandidateEffect, residual: np.ndarray, extension: np.ndarray) -> float:
    """Log evidence of a law by its own signature."""
    projected = space.project(space.whitened_design(law))
    projected -= extension @ (extension.T @ projected)
    sizes = np.array([p.prior_sigma for p in law.parameters])
    return coefficient_posterior(projected.T @ projected, projected.T @ residual, sizes)[2]


def test_a_constant_displacement_of_a_target_is_no_law(made):
    """That is its place, which is estimated; known lengths alone would feel it, and they have errors of their own."""
    assert not [p for p in made[1] if p.responses[0].changed_part == "target" and CONSTANT_REGRESSOR in p.regressors]


def test_priors_sum_to_1_over_everything(space, made):
    """Every kind of explanation, every card, law and change of the noise that is tried, at every place."""
    for table in (
        PRIOR_PROBABILITY_BY_CAUSE_CLASS,
        PRIOR_PROBABILITY_BY_PLACE_KIND,
        PRIOR_PROBABILITY_BY_RESPONSE_KIND,
        PRIOR_PROBABILITY_BY_RESPONSE_KIND_AT_TARGETS,
    ):
        assert sum(table.values()) == pytest.approx(1.0, abs=1e-12)
    assert sum(part for _, part in prior_table_rows()) == pytest.approx(1.0, abs=1e-12)
    assert np.exp(LOG_PRIOR_OF_EFFECT_SIZES).sum() == pytest.approx(1.0)
    _, batches, _ = made
    laws = sum(
        np.exp(p.log_prior_by_place).sum() * len(p.responses) * sum(len(d.coefficient_sigmas) for d in p.regressors)
        for p in batches
    )
    cards = CatalogueDesigns.from_residual_space(space, catalogue_candidate_effects(space.sightings))
    families = cards.log_evidence_by_family(np.zeros(len(cards.effects))) + cards.log_prior_by_family
    noise = NoiseHypothesisSet.from_residual_space(space, noise_hypotheses(space.sightings))
    nothing = np.append(
        noise._log_evidence_from_ratios(np.zeros((len(noise.hypotheses), 1))),
        [noise.log_prior_of_family(hypothesis.name) for hypothesis in noise.group_noise_hypotheses],
    )
    assert laws == pytest.approx(PRIOR_PROBABILITY_BY_CAUSE_CLASS["law"])
    assert np.exp(families).sum() == pytest.approx(PRIOR_PROBABILITY_BY_CAUSE_CLASS["named"])
    assert np.exp(nothing).sum() == pytest.approx(
        PRIOR_PROBABILITY_BY_CAUSE_CLASS["noise"] + PRIOR_PROBABILITY_BY_CAUSE_CLASS["scatter"]
    )


def test_effects_of_the_catalogue_share_their_prior_by_their_base_rates(space):
    """Effects that shift readings among themselves, and so do changes of the noise."""
    cards = CatalogueDesigns.from_residual_space(space, catalogue_candidate_effects(space.sightings))
    prior = dict(zip(cards.family_names, cards.log_prior_by_family, strict=True))
    assert prior["outlier"] - prior["window"] == pytest.approx(np.log(16.0))
    assert prior["station-bump"] - prior["head-sag"] == pytest.approx(np.log(4.0))
    noise = NoiseHypothesisSet.from_residual_space(space, noise_hypotheses(space.sightings))
    level, station = (noise.log_prior_of_family(name) for name in ("noise-level", "station-noise"))
    assert level - station == pytest.approx(np.log(4.0))


def test_the_theory_page_has_the_table_of_priors(root):
    page = (root / "docs" / "theory.md").read_text(encoding="utf-8")
    for words, part in prior_table_rows():
        assert f"| {words} | {100 * part:.3g} % |" in page


def test_a_set_is_scored_with_its_sizes_averaged(space):
    """Against the plain sum over all sizes of all members, each solved on its own."""
    effects = [find_effect("station-weather")(("S2",)), find_effect("backlash")()]
    members = [Hypothesis(e, -3.0, 0.0, e.name) for e in effects]
    designs = [space.whitened_design(e) for e in effects]
    projected = [space.project(g) for g in designs]
    whole = space.whitened_residuals + 9e-6 * projected[0][:, 0]
    model = EffectModel(tuple(members), tuple(projected), tuple(np.linalg.norm(g, axis=0) for g in designs), whole)
    sizes = [np.array([p.prior_sigma for p in e.parameters]) for e in effects]
    logs = []
    for size, weight in zip(RELATIVE_EFFECT_SIZES, LOG_PRIOR_OF_EFFECT_SIZES, strict=True):
        for other, more in zip(RELATIVE_EFFECT_SIZES, LOG_PRIOR_OF_EFFECT_SIZES, strict=True):
            columns = np.hstack([projected[0] * size * sizes[0], projected[1] * other * sizes[1]])
            inner = np.eye(columns.shape[1]) + columns.T @ columns
            score = columns.T @ whole
            fit = score @ np.linalg.solve(inner, score)
            logs.append(weight + more + 0.5 * (fit - np.linalg.slogdet(inner)[1]))
    assert model.penalised_log_evidence == pytest.approx(float(log_sum_exp(np.array(logs))) - 6.0, abs=0.02)
    single = EffectModel(tuple(members[:1]), tuple(projected[:1]), model.design_column_norms[:1], whole)
    alone_ = log_evidence_of_coefficients(projected[0].T @ projected[0], projected[0].T @ whole, sizes[0])
    assert single.penalised_log_evidence == pytest.approx(float(alone_) - 3.0, abs=1e-6)


def test_scores_by_sums_over_places_are_those_of_single_laws(space, made):
    _, batches, scored = made
    nothing = np.zeros((space.n_equations, 0))
    for (hits, _, _), panel in zip(scored, batches, strict=True):
        for hit in (hits[0], hits[-1]):
            scales = range(len(hit.regressor.coefficient_sigmas))
            laws = [
                EmpiricalLaw(hit.place.stations, hit.place.targets, hit.response, hit.regressor, length_scale_index=k)
                for k in scales
            ]
            logs = np.array([alone(space, law, space.whitened_residuals, nothing) for law in laws])
            exact = log_sum_exp(logs) + hit.log_prior
            assert hit.log_evidence == pytest.approx(float(exact), abs=0.02), (panel.responses[0], hit)


def test_a_selected_law_has_no_score_next_to_itself(space, made):
    probe, batches, _ = made
    law = EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["elevation"][0], scalar_regressor("move-elevation", "abs"))
    projected = space.project(space.whitened_design(law))
    projected /= np.linalg.norm(projected)
    residual = space.whitened_residuals + 20.0 * projected[:, 0]
    gains = []
    for extension in (np.zeros((space.n_equations, 0)), projected):
        extended = probe.with_model(residual - extension @ (extension.T @ residual), extension)
        hits = [
            h
            for panel in batches
            for h in panel.best_laws_and_log_total_evidence(extended)[0]
            if not (h.place.stations or h.place.targets)
        ]
        same = (h for h in hits if (h.response.name, h.regressor) == (law.response.name, law.regressor))
        gains.append(max((h.log_evidence - h.log_prior for h in same), default=-np.inf))
    assert gains[0] > 100.0
    assert gains[1] < 0.1


def test_many_effects_at_once_are_each_what_it_is_alone(space):
    law = EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["elevation"][0], scalar_regressor("time", "power"))
    local = [
        EmpiricalLaw(("S2",), (), RESPONSE_AND_DESIGN_BY_NAME["distance"][0], CONSTANT_REGRESSOR),
        EmpiricalLaw(("S2",), (), law.response, law.regressor),
    ]
    effects = [law, find_effect("index-drift")(), *local, find_effect("station-weather")(("S1",)), law]
    drift = find_effect("range-drift")()
    design_columns = space.whitened_design(drift)
    projected = space.project(design_columns)
    member = Hypothesis(drift, 0.0, 0.0, drift.name)
    base = EffectModel((member,), (projected,), (np.linalg.norm(design_columns, axis=0),), space.whitened_residuals)
    exact = EvidenceCalculator(space)
    for _ in range(2):
        values = [alone(space, effect, base.residual, base.projected_basis) for effect in effects]
        np.testing.assert_allclose(exact.log_evidence(effects, base), values, rtol=1e-8)
    np.testing.assert_allclose(exact.whitened_design(local[0]), space.whitened_design(local[0]))


def test_a_local_search_ends_at_the_rounding_error_of_the_evidence(space):
    """With readings a thousand times worse than declared it went on for gains of 1e-5 of 1e8, sixty steps far."""
    exact, steps = EvidenceCalculator(space), []
    law = EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["elevation"][0], scalar_regressor("time", "saturated", 1e3))
    linear = replace(law, regressor=replace(law.regressor, function="power", constant=1.0))
    readings = 1e5 * space.whitened_design(linear) @ linear.plausible_sizes
    base = EffectModel((), (), (), space.project(readings[:, None])[:, 0])
    inner = exact.log_evidence
    exact.log_evidence = lambda effects, model: steps.append(len(effects)) or inner(effects, model)
    ((_, value),) = exact.refine_locally([law], base)
    assert value > 1e8
    assert len(steps) < 30, len(steps)


def test_a_search_in_noise_has_expectation_zero(made):
    """Marginal likelihood ratios average to one where there is nothing."""
    for _, _, null in made[2]:
        assert log_sum_exp(null) - np.log(len(null)) < np.log(PRIOR_PROBABILITY_BY_CAUSE_CLASS["law"]) + 1.5


def test_simulated_residuals_stand_for_the_basis_in_large_networks(space, monkeypatch):
    monkeypatch.setattr("ltsim.diagnosis.null_ensemble.MAX_DENSE_UNKNOWNS", 0)
    probe = NullEnsemble.from_residual_space(space, 0, 0)
    assert probe.uses_monte_carlo_gram
    effects = [find_effect("station-weather")(("S2",)), find_effect("index-drift")()]
    _, _, sampled = CatalogueDesigns.from_residual_space(space, effects).screen(probe)
    monkeypatch.undo()
    _, _, exact = CatalogueDesigns.from_residual_space(space, effects).screen(
        NullEnsemble.from_residual_space(space, 0, 0)
    )
    for sampled_group, other in zip(sampled.groups, exact.groups, strict=True):
        np.testing.assert_allclose(sampled_group.projected_gram, other.projected_gram, rtol=0.4)


def test_what_is_like_a_finding_is_not_overrated_in_a_large_network(space, monkeypatch):
    """What is left of it beside the finding is a small difference of large numbers, one of them sampled."""
    steps = [step for step in find_effect("range-step").candidates(space.sightings) if step.stations == ("S2",)]
    member = Hypothesis(steps[len(steps) // 2], 0.0, 0.0, "range-step")
    design_columns = space.whitened_design(member.effect)
    projected = space.project(design_columns)
    base = EffectModel(
        (member,), (projected,), (np.linalg.norm(design_columns, axis=0),), 3.0 * space.whitened_residuals
    )
    values = []
    for most in (0, 500):
        monkeypatch.setattr("ltsim.diagnosis.null_ensemble.MAX_DENSE_UNKNOWNS", most)
        probe = NullEnsemble.from_residual_space(space, 0, 0)
        _, _, cards = CatalogueDesigns.from_residual_space(space, steps).screen(probe)
        values.append(cards.screen(probe.with_model(base.residual, base.projected_basis))[0])
    sampled, exact = values
    assert (sampled < 1.2 * np.maximum(exact, 0.0) + 1.0).all()


def test_evidence_is_that_of_the_dense_covariance():
    """log N(r; 0, 1 + t^2 G G') - log N(r; 0, 1), averaged over sizes, by determinants."""
    rng = random_stream(4, "dense")
    design_columns, residual = rng.standard_normal((12, 2)), rng.standard_normal(12)
    logs = []
    for t in RELATIVE_EFFECT_SIZES:
        covariance = np.eye(12) + t**2 * design_columns @ design_columns.T
        quadratic = residual @ (residual - np.linalg.solve(covariance, residual))
        logs.append(0.5 * (quadratic - np.linalg.slogdet(covariance)[1]))
    gram = design_columns.T @ design_columns
    posterior = coefficient_posterior(gram, design_columns.T @ residual, np.ones(2))
    assert posterior[2] == pytest.approx(float(log_sum_exp(np.array(logs) + LOG_PRIOR_OF_EFFECT_SIZES)))
    strength, turn = np.linalg.eigh(gram)
    assert posterior[2] == pytest.approx(float(log_evidence((turn.T @ design_columns.T @ residual) ** 2, strength)))


def test_a_negative_thickness_is_no_explanation():
    assert log_positivity_factor(3.0, 1.0) == pytest.approx(np.log(2.0), abs=0.01)
    assert log_positivity_factor(-5.0, 1.0) < -10.0


def test_unknown_is_reported_where_it_is_likelier_than_all_names_together():
    def ranking(**values: float) -> HypothesisRanking:
        law = EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["distance"][0], CONSTANT_REGRESSOR)
        return HypothesisRanking(tuple(Hypothesis(law, 0.0, v, n) for n, v in values.items()), 0.0)

    assert ranking(unknown=10.0, window=9.5, backlash=9.4).most_probable_name() == "window"
    assert ranking(unknown=10.0, window=9.0, backlash=8.0).most_probable_name() == "unknown"


def test_what_an_unknown_law_leaves_is_no_further_cause(space):
    law = EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["distance"][0], scalar_regressor("time", "power"))
    projected = space.project(space.whitened_design(law))
    unknown = Hypothesis(law, 0.0, 0.0, "unknown")
    hypothesis = Hypothesis(find_effect("index-drift")(), 0.0, 0.0, "index-drift")
    whole = 1e7 * projected[:, 0]
    models = [
        EffectModel((h,), (projected,), np.linalg.norm(projected, axis=0)[None], whole) for h in (unknown, hypothesis)
    ]
    assert models[0].discrepancy_penalty == pytest.approx(0.5 * UNCERTAIN_CHI2_FRACTION_OF_LAW * whole @ whole)
    assert models[1].discrepancy_penalty == 0.0


def test_the_largest_entries_are_those_of_a_stable_sort() -> None:
    values = np.round(random_stream(1, "largest").normal(size=(30, 40)))  # many equal entries
    values[3], values[4, :35], values[5, 2] = -np.inf, -np.inf, np.nan
    order = np.argsort(-values, axis=1, kind="stable")
    assert np.array_equal(indices_of_largest(values.copy(), 7), order[:, :7])
    assert np.array_equal(np.sort(indices_of_largest(values[:, :4].copy(), 7)), np.tile(np.arange(4), (30, 1)))


def test_nonzero_rows_are_those_of_the_whole_design() -> None:
    recording, _ = network(faces=2, values=drawn(misalignment_construction(), 1), seed=1)
    readings = recording.readings.copy()
    readings[3, 1], readings[7, 0] = np.nan, np.nan
    space = ResidualSpace.from_adjustment(adjust(recording.with_readings(readings), misalignment_construction()))
    assert len(space.adjustment.problem.gauge_rows) and not space.is_used_reading.all()
    changes_lengths = False
    for effect in catalogue_candidate_effects(space.sightings):
        whole = space.whitened_design(effect)
        rows, changes = space.nonzero_whitened_design(effect)
        assert np.array_equal(rows, np.flatnonzero(whole.any(axis=1)))
        assert np.array_equal(changes, whole[rows])
        changes_lengths |= bool(np.any(rows >= space.is_used_reading.sum()))
    assert changes_lengths
