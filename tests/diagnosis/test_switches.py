"""Laws that act in some spans of time or of a covariate: spans found by toggling, evidence without approximation."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.diagnosis.evidence import log_evidence_of_coefficients
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis
from ltsim.diagnosis.law_products import may_have_a_second_factor, product_forms
from ltsim.diagnosis.switches import _best_span_states, _span_gram_and_score, switched_forms
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import (
    CONSTANT_REGRESSOR,
    Regressor,
    path_length_regressor,
    scalar_regressor,
    smooth_regressor,
    switch_regressor,
)
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from ltsim.physics.model.construction import misalignment_construction
from ltsim.scene.regions import HallRegion
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def space() -> ResidualSpace:
    recording, _ = network(faces=2, values=drawn(misalignment_construction(), 1), seed=1)
    return ResidualSpace.from_adjustment(adjust(recording, misalignment_construction()))


def with_law(space: ResidualSpace, law: EmpiricalLaw, chi2: float) -> EffectModel:
    """Model without members, whose residuals hold a law of a given chi-square."""
    design_columns = space.project(space.whitened_design(law))[:, 0]
    return EffectModel(
        (), (), (), space.whitened_residuals + design_columns * np.sqrt(chi2) / np.linalg.norm(design_columns)
    )


def at(space: ResidualSpace, *shares: float) -> list[Regressor]:
    """Steps at fractions of the time of a recording."""
    time = np.unique(space.sightings.time)
    return [
        scalar_regressor("time", "step", float(0.5 * (time[i] + time[i - 1])))
        for i in (int(s * len(time)) for s in shares)
    ]


@pytest.mark.parametrize(
    "law",
    [
        EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["azimuth"][0], smooth_regressor("time")),
        EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["lean of the stand"][0], smooth_regressor("time")),
        EmpiricalLaw(
            (),
            (),
            RESPONSE_AND_DESIGN_BY_NAME["distance"][0],
            Regressor("product", factors=(smooth_regressor("time", 4), smooth_regressor("distance", 4))),
        ),
        EmpiricalLaw(
            (), (), RESPONSE_AND_DESIGN_BY_NAME["distance"][0], path_length_regressor(HallRegion("z", (1.0,), 0.5))
        ),
    ],
    ids=["angle", "two components", "product", "region"],
)
def test_moments_of_toggled_spans_are_those_of_the_switched_law(space: ResidualSpace, law: EmpiricalLaw) -> None:
    base = with_law(space, law.with_switch(at(space, 0.2, 0.45)), 200.0)
    exact, edges = EvidenceCalculator(space), law.candidate_switch_steps(space.sightings)
    first = scalar_regressor("time", "step", -np.inf)
    spans = _span_gram_and_score(exact, law, [first, *edges], base)
    on, _, toggled = _best_span_states(spans, law.with_switch([first]).plausible_sizes)
    assert toggled >= 1
    chosen = [edges[i] for i in np.flatnonzero(np.diff(on.astype(int)))]
    state, size = on.astype(float), np.sqrt(on @ spans.mean_square_contributions)
    gram = np.einsum("s,swtv,t->wv", state, spans.gram, state) / size**2
    switched = law.with_switch([first, *chosen] if on[0] else chosen)
    value = log_evidence_of_coefficients(gram, state @ spans.score / size, switched.plausible_sizes)
    assert float(value) == pytest.approx(float(exact.log_evidence([switched], base)[0]), rel=1e-6)


def test_the_times_of_a_machine_are_detected(space: ResidualSpace) -> None:
    law = EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["azimuth"][0], smooth_regressor("time"))
    times = at(space, 0.15, 0.3, 0.55, 0.8)
    base = with_law(space, law.with_switch(times), 600.0)
    exact = EvidenceCalculator(space)
    effect = switched_forms(exact, law, 0.0, base)[0].effect
    assert isinstance(effect, EmpiricalLaw) and effect.regressor.kind == "switch"
    values = exact.log_evidence([effect, law.with_switch(times)], base)
    assert values[0] > values[1] - 1.0  # changes between two set-ups are absorbed by their poses
    edges = np.array([edge.constant for edge in effect.regressor.factors])
    assert all(np.abs(edges - t.constant).min() < 60.0 for t in times[:3])


def test_air_that_is_cold_for_a_time_is_detected_from_the_times(space: ResidualSpace) -> None:
    region = path_length_regressor(HallRegion("z", (0.8,), 0.4))
    gate = switch_regressor(at(space, 0.1, 0.2, 0.4, 0.5))
    law = EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["distance"][0], Regressor("product", factors=(region, gate)))
    base, exact = with_law(space, law, 600.0), EvidenceCalculator(space)
    of_time = switched_forms(exact, EmpiricalLaw((), (), law.response, smooth_regressor("time")), 0.0, base)
    best_form = max(product_forms(exact, of_time[0], base), key=lambda form: form.log_evidence)
    assert isinstance(best_form.effect, EmpiricalLaw) and best_form.effect.regressor.hall_region is not None
    assert best_form.log_evidence > of_time[0].log_evidence + 20.0


def test_a_wave_in_azimuth_that_grows_with_the_distance_is_detected_from_the_wave(space: ResidualSpace) -> None:
    wave = Regressor("wave", ("azimuth",), constant=3.0)
    response = RESPONSE_AND_DESIGN_BY_NAME["elevation"][0]
    growing = EmpiricalLaw(
        (),
        (),
        response,
        Regressor("product", factors=(wave, scalar_regressor("distance", "power"))),
        length_scale_index=0,
    )
    base, exact = with_law(space, growing, 2000.0), EvidenceCalculator(space)
    plain = EmpiricalLaw((), (), response, wave)
    assert may_have_a_second_factor(plain) and not may_have_a_second_factor(growing)
    value = float(exact.log_evidence([plain], base)[0])
    best = max(
        product_forms(exact, Hypothesis(plain, 0.0, value, plain.name), base), key=lambda form: form.log_evidence
    )
    assert isinstance(best.effect, EmpiricalLaw)
    assert {q for factor in best.effect.regressor.factors for q in factor.covariates} == {"azimuth", "distance"}
    assert best.log_evidence > value + 20.0


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_band_of_a_coordinate_with_a_single_target_is_no_law(space: ResidualSpace, axis: str) -> None:
    """The cause belongs to that target: a wrong constant of its reflector, for example."""
    carrier, sightings = RESPONSE_AND_DESIGN_BY_NAME["distance"][0], space.sightings
    at = sightings.covariate_values[axis][np.unique(sightings.target, return_index=True)[1]]
    middle = int(np.argsort(at)[len(at) // 2])
    base = with_law(space, EmpiricalLaw((), (sightings.target_names[middle],), carrier, CONSTANT_REGRESSOR), 1e4)
    assert (
        switched_forms(EvidenceCalculator(space), EmpiricalLaw((), (), carrier, smooth_regressor(axis)), 0.0, base)
        == []
    )
