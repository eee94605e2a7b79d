"""Functional forms of a law: curve, short formulas, steps and ramps, common to all set-ups or separate for each.

Screening scores a law by one form; the best few laws are evaluated here in all forms, without approximation.
"""

from dataclasses import replace

import numpy as np

from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.diagnosis.evidence import TIE, best_of, evidence_with
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import Hypothesis, Model
from ltsim.diagnosis.prior import FORMS, P_PER_SETUP, P_PIECEWISE, P_SWITCHED
from ltsim.diagnosis.schema import Curve
from ltsim.physics.laws.columns import fourier_columns
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.names import catalogue_name
from ltsim.physics.laws.regressor_library import wave_regressors
from ltsim.physics.laws.regressors import scalar_regressor
from ltsim.scene.sightings import Sightings

LEAST_SWITCHED = {True: 1, False: 2}
"""Smallest number of switching times within set-ups of laws with and without a region of the hall; single steps without
a region are effects of the catalogue.
"""
MOST_PIECES, EARLY_STOP = 10, 3
"""Largest number of steps and ramps, and number of additional ones that are tried after the evidence has last
increased.
"""


def evaluate_forms(
    exact: EvidenceCalculator, law: EmpiricalLaw, log_prior: float, base: Model, *, pieces: bool
) -> list[Hypothesis]:
    """Evidence of a law in all its forms: the best form of each name, with the total evidence of that name."""
    sightings = exact.space.sightings
    law = law.equivalent_index_law(sightings)
    whole = log_prior + float(np.log(len(law.regressor.coefficient_sigmas)))
    tried = _in_pieces(exact, law, whole + float(np.log(P_PIECEWISE)), base) if pieces else []
    whole += float(np.log(1.0 - P_PIECEWISE)) if tried else 0.0
    always, share = law.without_switch(), float(np.log(P_SWITCHED * _courses(law, sightings)))
    switched = _switched(exact, always, whole + share, base) if pieces else []
    whole += float(np.log(1.0 - P_SWITCHED)) if switched else 0.0
    tried += switched
    each = law.per_setup(sightings)
    tried += _forms(exact, law, whole + (np.log(1.0 - P_PER_SETUP) if each else 0.0), base)
    tried += _forms(exact, each, whole + np.log(P_PER_SETUP), base) if each else []
    tried += _forms(exact, always, whole, base) if always != law else []
    best = []
    for name in {h.name: None for h in tried}:
        same_name = [h for h in tried if h.name == name]
        total = float(log_sum_exp(np.array([h.value for h in same_name])))
        best.append(replace(same_name[best_of(np.array([h.value for h in same_name]))], value=total))
    return best


def _forms(exact: EvidenceCalculator, law: EmpiricalLaw, prior: float, base: Model) -> list[Hypothesis]:
    """Functional forms of a law at its place."""
    forms = law.candidate_forms(exact.space.sightings)
    whole = sum(FORMS[kind] for kind in forms)
    shares = {kind: prior + float(np.log(FORMS[kind] / whole / len(sets))) for kind, sets in forms.items()}
    asked = [(shares[kind], scales) for kind, sets in forms.items() for scales in sets]
    single, several = ([form for form in asked if (len(form[1]) == 1) == is_single] for is_single in (True, False))
    climbed = exact.refine_locally([scales[0] for _, scales in single], base)
    candidates = [(share, *best) for (share, _), best in zip(single, climbed, strict=True)]
    moments = exact.moments([scales[0] for _, scales in several], base)
    for (share, scales), (gram, score) in zip(several, moments, strict=True):
        spreads = np.stack([scaled.size_scales for scaled in scales])
        logs = evidence_with(gram, score[None], spreads)
        candidates.append((share, scales[best_of(logs)], float(log_sum_exp(logs) - np.log(len(logs)))))
    return [Hypothesis(best, share, value + share, catalogue_name(best)) for share, best, value in candidates]


def _in_pieces(exact: EvidenceCalculator, law: EmpiricalLaw, prior: float, base: Model) -> list[Hypothesis]:
    """Forms of a law with a few steps and ramps, by forward selection while the evidence increases."""
    atoms = law.candidate_pieces(exact.space.sightings)
    if not atoms or len(law.targets) == 1:  # a target that moves, or sits badly, has cards
        return []
    whole = law.with_pieces(atoms)
    gram, score = exact.moments([whole], base)[0]
    spread = whole.size_scales
    places = np.arange(len(score)).reshape(len(whole.response.component_names), len(atoms), -1)
    chosen: list[int] = []
    taken, best, price = 0, -np.inf, float(np.log(2 * len(atoms)))  # which one, and that there is a further one
    while len(chosen) < min(taken + EARLY_STOP, MOST_PIECES, len(atoms)):
        values = np.full(len(atoms), -np.inf)
        free = [i for i in range(len(atoms)) if i not in chosen]
        columns = np.stack([places[:, [*chosen, i]].ravel() for i in free])
        values[free] = evidence_with(gram[columns[:, :, None], columns[:, None, :]], score[columns], spread[columns])
        chosen.append(best_of(values))
        value = float(log_sum_exp(values)) - len(chosen) * price
        if value > best + TIE:
            best, taken = value, len(chosen)
    refined, value = exact.refine_locally([law.with_pieces([atoms[i] for i in sorted(chosen[:taken])])], base)[0]
    prior -= taken * price
    return [Hypothesis(refined, prior, max(best + taken * price, value) + prior, catalogue_name(refined))]


def _is_within_a_set_up(time: float, sightings: Sightings) -> bool:
    """True if a set-up has pointings before and after a time; changes between set-ups are absorbed by their poses."""
    stays = (sightings.time[sightings.station == station] for station in np.unique(sightings.station))
    return any(stay.min() < time < stay.max() for stay in stays)


def _courses(law: EmpiricalLaw, sightings: Sightings) -> int:
    """Number of regressors that a switch may resemble, one for every rate of a wave, of which this is the best."""
    return (
        sum(wave.covariates == law.regressor.covariates for wave in wave_regressors(sightings))
        if law.regressor.kind == "wave"
        else 1
    )


def _switched(exact: EvidenceCalculator, law: EmpiricalLaw, prior: float, base: Model) -> list[Hypothesis]:
    """Forms of a law that is switched on and off with a constant amount.

    Intervals are toggled while the evidence increases.
    """
    sightings = exact.space.sightings
    edges = law.candidate_switch_times(sightings)
    if len(edges) < EARLY_STOP or len(law.targets) == 1:
        return []
    if law.depends_on_fixed_region:  # where it stands is refined before when
        law = exact.refine_locally([law], base)[0][0]
    ways, count = len(law.response.component_names), len(edges)
    gram, score = exact.moments([law.with_pieces(edges)], base)[0]
    after = sightings.time[:, None] > [edge.constant for edge in edges]
    sizes = np.sqrt(after.mean(axis=0))  # columns of steps have an rms of one
    squares = law.columns(sightings) ** 2 if law.depends_on_fixed_region else np.ones((len(after), 1))
    beyond = (squares * after).mean(axis=0)
    gram = gram.reshape(ways, count, ways, count) * np.outer(sizes, sizes)[:, None, :]
    score = score.reshape(ways, count) * sizes
    spans = -np.diff(np.concatenate([[1.0], beyond, [0.0]]))  # share of the squares before, between and after edges
    first, last = np.triu_indices(count + 1, 1)
    span = np.arange(count + 1)
    intervals = (span > first[:, None]) & (span <= last[:, None])
    spread = np.full((len(intervals), ways), law.response.plausible_size)
    on, states, best, taken, price = intervals[0], [np.zeros(count + 1, dtype=bool)], -np.inf, 0, np.log(len(intervals))
    while len(states) - 1 < min(taken + EARLY_STOP, MOST_PIECES):
        tried = states[-1] ^ intervals
        changes = np.diff(tried.astype(np.float64), axis=1) / np.sqrt(np.maximum(tried @ spans, 1e-12))[:, None]
        grams = np.einsum("pi,aibj,pj->pab", changes, gram, changes, optimize=True)
        values = evidence_with(grams, np.einsum("pi,ai->pa", changes, score), spread)
        values[~tried.any(axis=1)] = -np.inf
        states.append(tried[best_of(values)])
        value = float(log_sum_exp(values) - (len(states) - 1) * price)
        if value > best + TIE:
            on, best, taken = states[-1], value, len(states) - 1
    chosen = [edges[i] for i in np.flatnonzero(np.diff(on.astype(int)))]
    if law.depends_on_fixed_region and on[0]:
        chosen.insert(0, scalar_regressor("time", "step", -np.inf))
    least = LEAST_SWITCHED[law.depends_on_fixed_region]
    if sum(_is_within_a_set_up(edge.constant, sightings) for edge in chosen) < least:
        return []
    refined, value = exact.refine_locally([law.with_switch(chosen)], base)[0]
    prior -= float(taken * price)
    return [Hypothesis(refined, prior, max(best + taken * price, value) + prior, catalogue_name(refined))]


CURVE, A_CYCLE, MOST_POINTS = 61, 16, 600
"""Number of points of a reported curve, of each cycle of a wave, and largest number of points."""


def curve_of(law: EmpiricalLaw, sightings: Sightings, mean: Floats, covariance: Floats) -> Curve | None:
    """Curve at the set-up and in the direction of the largest response; None with several covariates.

    The coefficients have a `mean` (k,) and a `covariance` (k, k) [SI].
    """
    driver = law.regressor
    if len(driver.covariates) != 1 or driver.kind in ("amounts", "passage"):
        return None
    law, way, means, spread = law.at_largest_effect(mean, covariance, sightings)
    mean, covariance = way @ means, np.einsum("c,ckdl,d->kl", way, spread, way)
    x = sightings.quantities[driver.covariates[0]][law.row_weights(sightings) > 0]
    if driver.kind in ("wave", "cycle"):
        cycles = float(np.ptp(x)) * driver.constant / (2 * np.pi)
        at = np.linspace(x.min(), x.max(), int(np.clip(A_CYCLE * cycles, CURVE, MOST_POINTS)))
        columns = fourier_columns(driver.constant * at, driver.n_columns // 2)
    else:
        order = np.argsort(x, kind="stable")
        chosen = order[np.unique(np.linspace(0, len(order) - 1, CURVE).round().astype(int))]
        at, columns = x[chosen], law.columns(sightings)[law.row_weights(sightings) > 0][chosen]
    unit, factor = law.response.display_unit_of(int(np.argmax(np.abs(way))))
    sigma = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", columns, covariance, columns), 0.0))
    values = columns @ mean
    return Curve(
        covariate=driver.covariates[0],
        unit=unit,
        at=tuple(at.tolist()),
        value=tuple((values * factor).tolist()),
        sigma=tuple((sigma * factor).tolist()),
    )
