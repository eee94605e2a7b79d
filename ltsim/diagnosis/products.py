"""Products of the best law of a step with a second factor: a weight in distance or elevation, or a region of the hall.

A law of time that acts on some lines of sight alone is half seen as a law of all of them; what it acts on is found once
the time is known.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ltsim.diagnosis.evidence import best_of
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import Hypothesis, Model
from ltsim.diagnosis.switches import switched_forms
from ltsim.physics.laws.columns import LOW
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.names import name_of
from ltsim.physics.laws.regressor_library import OPERATOR_ODDS
from ltsim.physics.laws.regressors import CLOCKS, LEVER, Regressor, passage, simple, smooth
from ltsim.scene.regions import regions_of
from ltsim.scene.sightings import Sightings

WEIGHTS = ("distance", "elevation", "height")
"""Quantities to which the effect of a law may be proportional."""
SHAPES = ("z", "x", "y", "xy")
"""Shapes of the regions of the hall to which a law may be confined."""
MAX_COEFFICIENTS = 2
"""Largest number of coefficients of the function of time: those of a wave."""
WITHIN = 10.0
"""Largest deficit of log evidence, before refinement, of a product that is refined."""


def may_have_a_second_factor(law: Law) -> bool:
    """True for a law of one observable everywhere, with one function of time of at most two coefficients."""
    if law.carrier.kind != "reading" or law.carrier.units or law.stations or law.targets:
        return False
    return law.driver.size <= MAX_COEFFICIENTS and law.driver.covariates[:1] in [(name,) for name in CLOCKS]


def product_forms(exact: EvidenceCalculator, form: Hypothesis, base: Model) -> list[Hypothesis]:
    """Best product of a law of readings in time with a second factor, refined; empty if none is nearly as good."""
    law, sightings = form.effect, exact.space.sightings
    assert isinstance(law, Law)
    weights = list(_weights(sightings, LEVER if "distance" not in law.carrier.observables else ""))
    laws = [_times(law, weight) for weight in weights]
    values = exact.evidence(laws, base)
    top = best_of(values)
    prior = form.log_prior + float(np.log(OPERATOR_ODDS / len(weights)))
    if values[top] + prior < form.value - WITHIN:
        return []
    refined, value = exact.refine_locally([laws[top]], base)[0]
    products = [Hypothesis(refined, prior, value + prior, name_of(refined))]
    if law.driver.kind == "switch":
        weight = next(f for f in refined.driver.factors if f.kind != "switch")
        factor = weight if weight.region is not None else Regressor("product", factors=(smooth("time", LOW), weight))
        alone = replace(refined, driver=factor)
        products += switched_forms(exact, alone, prior, base, refine=False)
    return products


def _times(law: Law, weight: Regressor) -> Law:
    """Product of a law with a second factor; a region comes first."""
    factors = (weight, law.driver) if weight.region is not None else (law.driver, weight)
    return replace(law, driver=Regressor("product", factors=factors), scale=0)


def _weights(sightings: Sightings, function: str) -> Iterator[Regressor]:
    """Second factors: powers of quantities, and regions of the hall (`function` of `passage`)."""
    for name in WEIGHTS:
        if np.ptp(sightings.quantities[name]) > 0:
            yield simple(name, "power")
    yield from (passage(region, function) for region in regions_of(sightings, SHAPES))
