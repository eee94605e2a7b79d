"""Products of an empirical law with a second factor: distance, elevation, height, or a region of the hall.

An error can be proportional to the distance, or act only on some lines of sight. A law that acts equally on all lines
of sight already explains about half of such an error. The second factor is therefore tried only for the law with the
largest evidence in a step of the search. Regions of the hall are tried only as factors of laws of time.
"""

from dataclasses import replace

import numpy as np

from ltsim.diagnosis.evidence import MAX_LOG_EVIDENCE_DEFICIT_FOR_EXACT_EVALUATION, index_of_most_evidence
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis
from ltsim.diagnosis.switches import switched_forms
from ltsim.physics.laws.catalogue_names import equivalent_effect_name
from ltsim.physics.laws.columns import N_PRODUCT_CURVE_MODES
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressor_library import ODDS_PER_OPERATOR
from ltsim.physics.laws.regressors import (
    CLOCK_COVARIATES,
    DEFLECTION_FUNCTION,
    Regressor,
    path_length_regressor,
    scalar_regressor,
    smooth_regressor,
)
from ltsim.scene.regions import candidate_regions

SECOND_FACTOR_COVARIATES = ("distance", "elevation", "height")
"""Covariates to which the change by an empirical law (error as a function of covariates) may be proportional in
addition (second factor)."""
SECOND_FACTOR_REGION_SHAPES = ("z", "x", "y", "xy")
"""Shapes of the regions of the hall to which an empirical law (error as a function of covariates) may be confined,
given by the axes along which a region is bounded."""
MAX_COEFFICIENTS_WITH_SECOND_FACTOR = 2
"""Largest number of coefficients of an empirical law (error as a function of covariates) for which a second factor is
tried; a wave has two."""


def may_have_a_second_factor(law: EmpiricalLaw) -> bool:
    """True for an empirical law of one observable in the whole network with one covariate and few coefficients.

    An empirical law describes an error as a function of covariates.
    """
    if law.response.changed_part != "reading" or law.response.component_units or law.stations or law.targets:
        return False
    regressor = law.regressor
    is_simple = regressor.kind in ("simple", "wave") and len(regressor.covariates) == 1
    return regressor.n_columns <= MAX_COEFFICIENTS_WITH_SECOND_FACTOR and (is_simple or _is_of_time(regressor))


def _is_of_time(regressor: Regressor) -> bool:
    """True for a regressor (function of covariates) that is a function of time, such as a switch (on and off)."""
    return regressor.covariates[:1] in [(name,) for name in CLOCK_COVARIATES]


def product_forms(
    calculator: EvidenceCalculator, form: Hypothesis, conditioning_model: EffectModel
) -> list[Hypothesis]:
    """List with the best product of an empirical law of readings and a second factor, after a local search.

    An empirical law describes an error as a function of covariates. `form` is the law. The list is empty if no product
    has nearly the evidence of the law. For a law that is switched on and off, the list also contains other functions as
    factors. The effects of `conditioning_model` are estimated in addition.
    """
    law, sightings = form.effect, calculator.residual_space.sightings
    assert isinstance(law, EmpiricalLaw)
    weights = [
        scalar_regressor(name, "power")
        for name in SECOND_FACTOR_COVARIATES
        if np.ptp(sightings.covariate_values[name]) > 0 and name not in law.regressor.covariates
    ]
    if _is_of_time(law.regressor):
        function = DEFLECTION_FUNCTION if "distance" not in law.response.observables else ""
        regions = candidate_regions(sightings, SECOND_FACTOR_REGION_SHAPES)
        weights += [path_length_regressor(region, function) for region in regions]
    if not weights:
        return []
    laws = [_law_product(law, weight) for weight in weights]
    log_evidences = calculator.log_evidence(laws, conditioning_model)
    top = index_of_most_evidence(log_evidences)
    prior = form.log_prior + float(np.log(ODDS_PER_OPERATOR / len(weights)))
    if log_evidences[top] + prior < form.log_evidence - MAX_LOG_EVIDENCE_DEFICIT_FOR_EXACT_EVALUATION:
        return []
    refined, value = calculator.refine_locally([laws[top]], conditioning_model)[0]
    products = [Hypothesis(refined, prior, value + prior, equivalent_effect_name(refined))]
    if law.regressor.kind == "switch":
        weight = next(f for f in refined.regressor.factors if f.kind != "switch")
        factor = (
            weight
            if weight.region is not None
            else Regressor("product", factors=(smooth_regressor("time", N_PRODUCT_CURVE_MODES), weight))
        )
        alone = replace(refined, regressor=factor)
        products += switched_forms(calculator, alone, prior, conditioning_model, refines_region=False)
    return products


def _law_product(law: EmpiricalLaw, second_factor: Regressor) -> EmpiricalLaw:
    """Product of an empirical law with the function `second_factor`; a region of the hall becomes the first factor.

    An empirical law describes an error as a function of covariates.
    """
    factors = (second_factor, law.regressor) if second_factor.region is not None else (law.regressor, second_factor)
    return replace(law, regressor=Regressor("product", factors=factors), length_scale_index=0)
