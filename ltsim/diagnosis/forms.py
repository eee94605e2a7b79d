"""Functional forms of an empirical law: curve, formula, steps and ramps, common to all set-ups or separate for each.

The screening evaluates each law in one form only. The few laws with the largest evidence are evaluated here in all
forms, without approximation.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.component_ratios import best_component_ratio
from ltsim.diagnosis.evidence import index_of_most_evidence, log_evidence_of_coefficients
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis
from ltsim.diagnosis.law_products import may_have_a_second_factor, product_forms
from ltsim.diagnosis.law_search_space import MIN_POINTINGS_PER_COEFFICIENT
from ltsim.diagnosis.prior import (
    P_EVEN_ODDS,
    P_RARE_LAW_FORM,
    P_SINGLE_SET_UP_BY_CHANGED_PART,
    PRIOR_WEIGHT_BY_LAW_FORM,
)
from ltsim.diagnosis.schema import ResponseCurve
from ltsim.diagnosis.switches import (
    MAX_PIECES_OF_LAW,
    N_TOGGLED_INTERVALS_AFTER_MAXIMUM,
    n_tried_waves_of_same_covariate,
    switched_forms,
)
from ltsim.physics.laws.catalogue_names import equivalent_effect_name
from ltsim.physics.laws.columns import fourier_columns
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import CONSTANT_REGRESSOR, COORDINATE_COVARIATES, Regressor
from ltsim.scene.sightings import Sightings

RIGID_MOTION_REGRESSOR = Regressor("field", COORDINATE_COVARIATES, constant=1.0)
"""Regressor (function of covariates) (function of the coordinates) for a group of targets that moves and tilts as a
rigid body."""
MAX_LOG_EVIDENCE_DIFFERENCE_TO_SINGLE_SET_UP_LAW = 0.5
"""Largest difference of log evidence between an empirical law (error as a function of covariates) at all set-ups and
the same law at one set-up that count as equivalent. Equivalent laws differ only by poses of the other set-ups; only the
law at one set-up is retained."""


def min_log_evidence_for_forms(best_evidence: float) -> float:
    """Approximate log evidence above which an empirical law is evaluated in all functional forms.

    An empirical law describes an error as a function of covariates. The limit is about half of `best_evidence`, the
    largest log evidence of a law, because another form may double the log evidence.
    """
    return 0.5 * best_evidence - 5.0


def evaluate_law_forms(
    calculator: EvidenceCalculator,
    law: EmpiricalLaw,
    log_prior: float,
    conditioning_model: EffectModel,
    *,
    with_steps_and_switches: bool,
) -> list[Hypothesis]:
    """Hypotheses for the functional forms of an empirical law: the best form for each effect name.

    An empirical law describes an error as a function of covariates. A form that equals a catalogue effect has its name;
    all other forms are `unknown`. The evidence of a result is the sum over all forms with its name. `log_prior` is the
    log prior probability of the law. The effects of `conditioning_model` are estimated in addition. Steps, ramps and
    switches (on or off in intervals of a covariate) are tried if `with_steps_and_switches`.
    """
    sightings = calculator.residual_space.sightings
    law = law.equivalent_vertical_index_law(sightings)
    base_evidence = log_prior + float(np.log(len(law.regressor.coefficient_sigmas)))
    hypotheses = (
        _piecewise_forms(calculator, law, base_evidence + float(np.log(P_RARE_LAW_FORM)), conditioning_model)
        if with_steps_and_switches
        else []
    )
    base_evidence += float(np.log(1.0 - P_RARE_LAW_FORM)) if hypotheses else 0.0
    permanent_law, share = (
        law.without_time_limit(),
        float(np.log(P_RARE_LAW_FORM * n_tried_waves_of_same_covariate(law, sightings))),
    )
    switch_hypotheses = (
        switched_forms(calculator, permanent_law, base_evidence + share, conditioning_model)
        if with_steps_and_switches
        else []
    )
    base_evidence += float(np.log(1.0 - P_RARE_LAW_FORM)) if switch_hypotheses else 0.0
    hypotheses += switch_hypotheses
    setup_laws = law.with_coefficients_per_setup(sightings)
    hypotheses += _functional_forms(
        calculator, law, base_evidence + (np.log(1.0 - P_RARE_LAW_FORM) if setup_laws else 0.0), conditioning_model
    )
    hypotheses += (
        _functional_forms(calculator, setup_laws, base_evidence + np.log(P_RARE_LAW_FORM), conditioning_model)
        if setup_laws
        else []
    )
    hypotheses += (
        _functional_forms(calculator, permanent_law, base_evidence, conditioning_model) if permanent_law != law else []
    )
    factors = (
        [h for h in hypotheses if isinstance(h.effect, EmpiricalLaw) and may_have_a_second_factor(h.effect)]
        if with_steps_and_switches
        else []
    )
    hypotheses += product_forms(calculator, factors[_index_of_best(factors)], conditioning_model) if factors else []
    hypotheses = [
        form for hypothesis in hypotheses for form in _forms_with_ratio(calculator, hypothesis, conditioning_model)
    ]
    top = hypotheses.pop(_index_of_best(hypotheses))
    hypotheses += _forms_at_single_set_ups(calculator, top, conditioning_model)
    best_items = []
    for name in {h.name: None for h in hypotheses}:
        same_name = [h for h in hypotheses if h.name == name]
        total = float(log_sum_exp(np.array([h.log_evidence for h in same_name])))
        best_items.append(replace(same_name[_index_of_best(same_name)], log_evidence=total))
    return best_items


def _index_of_best(forms: Sequence[Hypothesis]) -> int:
    """Index of the hypothesis with the largest log evidence among `forms` (functions of an empirical law).

    An empirical law describes an error as a function of covariates.
    """
    return index_of_most_evidence(np.array([form.log_evidence for form in forms]))


def _functional_forms(
    calculator: EvidenceCalculator, law: EmpiricalLaw, log_prior: float, conditioning_model: EffectModel
) -> list[Hypothesis]:
    """Forms of an empirical law as a curve, a formula, a piecewise function or a product, each with its log evidence.

    An empirical law describes an error as a function of covariates. `log_prior` is the log prior probability of the
    law. The effects of `conditioning_model` are estimated in addition.
    """
    forms = law.candidate_forms_by_kind(calculator.residual_space.sightings)
    weight_sum = sum(PRIOR_WEIGHT_BY_LAW_FORM[kind] for kind in forms)
    shares = {
        kind: log_prior + float(np.log(PRIOR_WEIGHT_BY_LAW_FORM[kind] / weight_sum / len(sets)))
        for kind, sets in forms.items()
    }
    form_scales = [(shares[kind], scales) for kind, sets in forms.items() for scales in sets]
    single, several = (
        [form for form in form_scales if (len(form[1]) == 1) == is_single] for is_single in (True, False)
    )
    refined = calculator.refine_locally([scales[0] for _, scales in single], conditioning_model)
    candidates = [(share, *best) for (share, _), best in zip(single, refined, strict=True)]
    moments = calculator.grams_and_scores([scales[0] for _, scales in several], conditioning_model)
    for (share, scales), (gram, score) in zip(several, moments, strict=True):
        spreads = np.stack([scaled.plausible_sizes for scaled in scales])
        logs = log_evidence_of_coefficients(gram, score[None], spreads)
        candidates.append((share, scales[index_of_most_evidence(logs)], float(log_sum_exp(logs) - np.log(len(logs)))))
    return [Hypothesis(best, share, value + share, equivalent_effect_name(best)) for share, best, value in candidates]


def _forms_with_ratio(
    calculator: EvidenceCalculator, form: Hypothesis, conditioning_model: EffectModel
) -> list[Hypothesis]:
    """List of `form`, an empirical law, and possibly of this law with a fixed ratio of its components.

    An empirical law describes an error as a function of covariates. The fixed ratio is tried if each component has
    several coefficients. The effects of `conditioning_model` are estimated in addition.
    """
    law = form.effect
    assert isinstance(law, EmpiricalLaw)
    if law.n_setup_components == 1 or law.regressor.n_columns == 1 or law.component_ratio:
        return [form]
    gram, score = calculator.grams_and_scores([law], conditioning_model)[0]
    ratio, evidence, log_share = best_component_ratio(gram, score, law.plausible_sizes, law.n_setup_components)
    gain = evidence - float(log_evidence_of_coefficients(gram, score, law.plausible_sizes))
    share, other = np.log(P_EVEN_ODDS) + log_share, np.log(1.0 - P_EVEN_ODDS)
    return [
        replace(form, log_prior=form.log_prior + other, log_evidence=form.log_evidence + other),
        replace(
            form,
            effect=replace(law, component_ratio=ratio),
            log_prior=form.log_prior + share,
            log_evidence=form.log_evidence + gain + share,
        ),
    ]


def _forms_at_single_set_ups(
    calculator: EvidenceCalculator, form: Hypothesis, conditioning_model: EffectModel
) -> list[Hypothesis]:
    """List of `form`, an empirical law (function of covariates) at all set-ups, and of the same law at single set-ups.

    If the poses of all set-ups except one absorb the law, the list contains only the law at this set-up. The effects of
    `conditioning_model` are estimated in addition.
    """
    law, stations = form.effect, calculator.residual_space.sightings.station_names
    assert isinstance(law, EmpiricalLaw)
    if law.stations or law.instruments or len(stations) < 2:
        return [form]
    drivers = (
        [law.regressor, CONSTANT_REGRESSOR, RIGID_MOTION_REGRESSOR]
        if law.targets and law.response.changed_part == "target"
        else [law.regressor]
    )
    drivers = [d for d in dict.fromkeys(drivers) if all(f.covariates != ("station",) for f in (d, *d.factors))]
    laws = [
        replace(
            law,
            stations=(name,),
            regressor=driver.with_field_centred_on(law.targets),
            length_scale_index=0,
            component_ratio=(),
        )
        for driver in drivers
        for name in stations
    ]
    n_pointings = [law.pointing_indicator(calculator.residual_space.sightings).sum() for law in laws]
    laws = [x for x, n in zip(laws, n_pointings, strict=True) if n >= MIN_POINTINGS_PER_COEFFICIENT * len(x.parameters)]
    share = P_SINGLE_SET_UP_BY_CHANGED_PART.get(law.response.changed_part, P_RARE_LAW_FORM)
    log_prior = form.log_prior + float(np.log(share / max(len(laws), 1)))
    log_evidences = calculator.log_evidence(laws, conditioning_model)
    hypotheses = [
        Hypothesis(x, log_prior, float(value) + log_prior, equivalent_effect_name(x))
        for x, value in zip(laws, log_evidences, strict=True)
    ]
    with_ratios = [
        other for hypothesis in hypotheses for other in _forms_with_ratio(calculator, hypothesis, conditioning_model)
    ]
    evidence = form.log_evidence - form.log_prior
    same = [
        replace(h, log_prior=form.log_prior, log_evidence=h.log_evidence + form.log_prior - h.log_prior)
        for h in with_ratios
        if isinstance(h.effect, EmpiricalLaw)
        and h.effect.regressor == law.regressor.with_field_centred_on(law.targets)
        and abs(h.log_evidence - h.log_prior - evidence) < MAX_LOG_EVIDENCE_DIFFERENCE_TO_SINGLE_SET_UP_LAW
    ]
    return same[:1] or [form, *with_ratios]


def _piecewise_forms(
    calculator: EvidenceCalculator, law: EmpiricalLaw, log_prior: float, conditioning_model: EffectModel
) -> list[Hypothesis]:
    """List of an empirical law (function of covariates) with a sum of steps and ramps, in place of its curve.

    Steps and ramps are added while the evidence increases. The list is empty for a law without a curve, and for a law
    that acts on a single target. `log_prior` is the log prior probability of the result. The effects of
    `conditioning_model` are estimated in addition.
    """
    atoms = law.candidate_steps_and_ramps(calculator.residual_space.sightings)
    if not atoms or len(law.targets) == 1:  # the catalogue has effects for it
        return []
    full_law = law.with_steps_and_ramps(atoms)
    gram, score = calculator.grams_and_scores([full_law], conditioning_model)[0]
    spread = full_law.plausible_sizes
    places = np.arange(len(score)).reshape(len(full_law.response.component_names), len(atoms), -1)
    atom_indices: list[int] = []
    n_selected, best, log_price = (
        0,
        -np.inf,
        float(np.log(2 * len(atoms))),
    )  # prior of the choice of a piece, and of a further piece
    while len(atom_indices) < min(n_selected + N_TOGGLED_INTERVALS_AFTER_MAXIMUM, MAX_PIECES_OF_LAW, len(atoms)):
        values = np.full(len(atoms), -np.inf)
        remaining = [i for i in range(len(atoms)) if i not in atom_indices]
        columns = np.stack([places[:, [*atom_indices, i]].ravel() for i in remaining])
        values[remaining] = log_evidence_of_coefficients(
            gram[columns[:, :, None], columns[:, None, :]], score[columns], spread[columns]
        )
        atom_indices.append(index_of_most_evidence(values))
        value = float(log_sum_exp(values)) - len(atom_indices) * log_price
        if value > best + NORMAL_EQUATIONS_TOLERANCE:
            best, n_selected = value, len(atom_indices)
    refined, value = calculator.refine_locally(
        [law.with_steps_and_ramps([atoms[i] for i in sorted(atom_indices[:n_selected])])], conditioning_model
    )[0]
    log_prior -= n_selected * log_price
    return [
        Hypothesis(
            refined, log_prior, max(best + n_selected * log_price, value) + log_prior, equivalent_effect_name(refined)
        )
    ]


N_REPORTED_CURVE_POINTS = 61
"""Number of points of a reported curve, except for a wave with many cycles."""
N_CURVE_POINTS_PER_CYCLE = 16
"""Number of points per cycle of a wave in a reported curve."""
MAX_REPORTED_CURVE_POINTS = 600
"""Largest number of points of a reported curve."""


def response_curve(
    law: EmpiricalLaw, sightings: Sightings, coefficient_mean: Floats, coefficient_covariance: Floats
) -> ResponseCurve | None:
    """Curve of an empirical law over its covariate, at the set-up and in the direction with the largest effect.

    An empirical law describes an error as a function of covariates. The result is None for a law with several
    covariates, or with a separate size at each set-up. The k coefficients of the law have the mean `coefficient_mean`
    (k,) and the covariance `coefficient_covariance` (k, k) [SI].
    """
    regressor = law.regressor
    if len(regressor.covariates) != 1 or regressor.kind in ("amounts", "passage"):
        return None
    law, way, means, spread = law.law_at_setup_of_largest_effect(coefficient_mean, coefficient_covariance, sightings)
    coefficient_mean, coefficient_covariance = way @ means, np.einsum("c,ckdl,d->kl", way, spread, way)
    x = sightings.covariate_values[regressor.covariates[0]][law.pointing_indicator(sightings) > 0]
    if regressor.kind in ("wave", "cycle"):
        cycles = float(np.ptp(x)) * regressor.constant / (2 * np.pi)
        at = np.linspace(
            x.min(),
            x.max(),
            int(np.clip(N_CURVE_POINTS_PER_CYCLE * cycles, N_REPORTED_CURVE_POINTS, MAX_REPORTED_CURVE_POINTS)),
        )
        columns = fourier_columns(regressor.constant * at, regressor.n_columns // 2)
    else:
        order = np.argsort(x, kind="stable")
        chosen = order[np.unique(np.linspace(0, len(order) - 1, N_REPORTED_CURVE_POINTS).round().astype(int))]
        at, columns = x[chosen], law.columns(sightings)[law.pointing_indicator(sightings) > 0][chosen]
    unit, factor = law.response.display_unit_and_factor_on_coefficient(int(np.argmax(np.abs(way))))
    sigma = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", columns, coefficient_covariance, columns), 0.0))
    curve_values = columns @ coefficient_mean
    return ResponseCurve(
        covariate=regressor.covariates[0],
        unit=unit,
        at=tuple(at.tolist()),
        value=tuple((curve_values * factor).tolist()),
        sigma=tuple((sigma * factor).tolist()),
    )
