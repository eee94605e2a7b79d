"""Prior probabilities of a diagnosis, normalised over all explanations of a recording.

An explanation is a possible cause of the misfit. A cause, and no cause, have equal prior probabilities. The probability
of a cause is divided among kinds of explanations. The probability of a kind is divided among all its explanations that
are possible in a recording. Catalogue effects have probabilities in proportion to their base rates
(`Effect.base_rate`), divided equally among their possible places (stations and targets) and shape parameters. Empirical
laws have probabilities by their responses (changed quantities), regressors (functions of covariates) and places. Each
operator of a regressor has the factor `laws.regressor_library.ODDS_PER_OPERATOR`. `prior_table_rows` is the table on
the theory page. The numbers are judgements of how often a cause occurs in service. Several were revised after
experiments with known causes. A factor of two in one of them changes the log evidence by 0.7.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.probability import PRIOR_OF_WRONG_INSTRUMENT_CONSTANT
from ltsim.physics.effects import find_effect

PRIOR_PROBABILITY_BY_CAUSE_CLASS = {
    "named": 0.53,
    "law": 0.3,
    "noise": 0.095,
    "scatter": 0.035,
    "constant": PRIOR_OF_WRONG_INSTRUMENT_CONSTANT,
}
"""Prior probability of each kind of cause of a misfit, given that there is a cause."""
CAUSE_KIND_DESCRIPTIONS = {
    "named": "an effect of the catalogue that shifts readings",
    "law": "an empirical law outside the catalogue",
    "noise": "a changed noise level that the catalogue contains",
    "scatter": "another changed noise level",
    "constant": ("an instrument constant that contradicts the other instruments, its history or a declared correction"),
}
"""Description, shown to users, of each kind of cause of a misfit, by the keys of `PRIOR_PROBABILITY_BY_CAUSE_CLASS`."""
P_UNMODELLED_CAUSE = 0.2
"""Prior probability that a cause is neither a catalogue effect nor an empirical law (error as a function of
covariates), but resembles one of these."""
P_EVEN_ODDS = 0.5
"""Prior probability of a statement that is as probable as its contrary. The statements are: an unmodelled cause acts on
the observable of the effect that it resembles; the components of an empirical law (error as a function of covariates)
have a fixed ratio."""
MAX_P_OF_TEST_FINDINGS = 1.0 - P_UNMODELLED_CAUSE * P_EVEN_ODDS
"""Largest probability that is reported for findings of tests, whose probabilities do not include an unmodelled
cause."""
PRIOR_PROBABILITY_BY_PLACE_KIND = {"everywhere": 0.5, "set-up": 0.2, "instrument": 0.1, "target": 0.1, "group": 0.1}
"""Prior probability of each kind of place (set-up, instrument, target and so on) where an empirical law (error as a
function of covariates) acts."""
PLACE_KIND_DESCRIPTIONS = {
    "everywhere": "everywhere",
    "set-up": "at a set-up",
    "instrument": "on an instrument",
    "target": "at a target",
    "group": "at a group of targets",
}
"""Descriptions, shown to users, of the kinds of places where an error law may act, such as one set-up or all targets.
"""
PRIOR_PROBABILITY_BY_RESPONSE_KIND = {
    "reading": 0.5,
    "instrument": 0.17,
    "circle": 0.03,
    "stand": 0.2,
    "target": 0.04,
    "reflector": 0.02,
    "air": 0.04,
}
"""Prior probability of each kind of response, the quantity that an empirical law (error as a function of covariates)
changes. An unknown error mostly affects only a reading. If all targets seem to move, it is more probable that the
stands move."""
PRIOR_PROBABILITY_BY_RESPONSE_KIND_AT_TARGETS = {"reading": 0.15, "target": 0.75, "reflector": 0.1}
"""Prior probability of each kind of quantity that an empirical law (error as a function of covariates) changes if it
acts at some targets only. Mostly the target itself changes, because an error of the instrument does not depend on the
target."""
PRIOR_WEIGHT_BY_LAW_FORM = {"curve": 0.5, "formula": 0.4, "fine": 0.1, "cycle": 0.2, "members": 0.2}
"""Prior weights of the functional forms that an empirical law (error as a function of covariates) may have. The weights
are divided by their sum over the forms that are possible for the law. The most probable forms are a curve and a
formula."""
P_RARE_LAW_FORM = 0.1
"""Prior probability of each rarer function of an empirical law (error as a function of covariates): a few steps and
ramps; a law that is switched on and off; separate coefficients at each set-up; a law at one set-up alone, except for
the changed parts in `P_SINGLE_SET_UP_BY_CHANGED_PART`."""
P_SINGLE_SET_UP_BY_CHANGED_PART = {"stand": 0.5}
"""Prior probability that an empirical law (error as a function of covariates) acts at only one set-up, by the part of
the system that it changes. It is large for stands, which differ between set-ups more than instruments do."""
MAX_MODEL_EFFECTS = 5
"""Largest number of effects in a model, and largest number of reported instrument constants."""
MIN_EFFECT_LOG_EVIDENCE = 2.0
"""Smallest increase of the log evidence by an additional effect. It represents a geometric prior on the number of
effects, with prior odds of e^-2 (1 to 7) for each additional effect."""
LOG_PRIOR_ODDS_OF_REPETITION = float(np.log(0.03))
"""Log prior odds of a second effect with the same name (two glass panes, two unknown effects), relative to a second
effect with another name. They apply to effects that rarely occur twice."""


def log_prior_of_each_explanation(cause_kind: str, n_explanations: int) -> float:
    """Log prior probability of each of `n_explanations` possible causes of one kind.

    `cause_kind` is a key of `PRIOR_PROBABILITY_BY_CAUSE_CLASS`.
    """
    return float(np.log(PRIOR_PROBABILITY_BY_CAUSE_CLASS[cause_kind] / max(n_explanations, 1)))


def log_prior_by_base_rate(cause_kind: str, names: Sequence[str]) -> Floats:
    """Log prior probabilities (n,) of n catalogue effects, given by name, in proportion to their base rates.

    `cause_kind` is the key of `PRIOR_PROBABILITY_BY_CAUSE_CLASS` with the probability that is divided among them.
    """
    rates = np.array([find_effect(name).base_rate for name in names])
    return log_prior_of_each_explanation(cause_kind, 1) + np.log(rates / rates.sum())


def prior_table_rows() -> Iterator[tuple[str, float]]:
    """Pairs of description and prior probability of every kind of cause; the probabilities add up to one."""
    for kind, part in PRIOR_PROBABILITY_BY_CAUSE_CLASS.items():
        if kind != "law":
            yield CAUSE_KIND_DESCRIPTIONS[kind], part
            continue
        yield from (
            (f"{CAUSE_KIND_DESCRIPTIONS[kind]} that acts {PLACE_KIND_DESCRIPTIONS[where]}", part * share)
            for where, share in PRIOR_PROBABILITY_BY_PLACE_KIND.items()
        )
