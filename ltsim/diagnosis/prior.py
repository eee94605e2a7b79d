"""Prior of a diagnosis: one table of probabilities, normalised over all explanations of a recording.

An unmodelled cause and none have equal prior probability. The probability of a cause is divided among kinds of
explanations, and each part equally among all of its kind that are possible in a recording: effects of the catalogue,
their places and shapes, responses, regressors and places of laws (each operator of a regressor has the factor
`laws.regressor_library.OPERATOR_ODDS`). `prior_rows` is the table on the theory page. The numbers are judgements of how
often a cause occurs in service; several were revised after experiments with known causes. A factor of two in one of
them is
0.7 of log evidence.
"""

from collections.abc import Iterator

import numpy as np

from ltsim.core.probability import P_CONSTANT

CAUSE_PRIOR = {"named": 0.53, "law": 0.3, "noise": 0.095, "scatter": 0.035, "constant": P_CONSTANT}
"""Prior probability of each kind of unmodelled cause, given that there is one."""
CAUSE_TEXTS = {
    "named": "an effect of the catalogue that shifts readings",
    "law": "an empirical law outside the catalogue",
    "noise": "a change of the noise of the catalogue",
    "scatter": "another variance function of the noise",
    "constant": (
        "a constant of an instrument that contradicts the other instruments, its history or a declared correction"
    ),
}
"""Texts of the kinds in `CAUSE_PRIOR`."""
P_UNMODELLED = 0.2
"""Prior probability that a cause is in no list but resembles a listed one."""
P_EVEN = 0.5
"""Probability of one of two alternatives between which nothing decides beforehand: an unmodelled cause acts on the
observable of the listed cause that it resembles; the components of a law have a fixed ratio.
"""
P_CAP_TESTS = 1.0 - P_UNMODELLED * P_EVEN
"""Upper limit on the probability reported for findings that have no likelihood term for an unmodelled cause."""
PLACE_PRIOR = {"everywhere": 0.5, "set-up": 0.2, "instrument": 0.1, "target": 0.1, "group": 0.1}
"""Prior probability of each kind of place at which a law outside the catalogue acts."""
RESPONSE_PRIOR = {
    "reading": 0.5,
    "instrument": 0.17,
    "circle": 0.03,
    "stand": 0.2,
    "target": 0.04,
    "reflector": 0.02,
    "air": 0.04,
}
"""Prior probability of each kind of response. An unknown error mostly affects a reading alone; if all targets seem to
move, the stands move."""
RESPONSE_PRIOR_AT_TARGETS = {"reading": 0.15, "target": 0.75, "reflector": 0.1}
"""Prior probability of each kind of response for causes at some targets only. Mostly the target itself changes, because
the instrument does not depend on it."""
FORM_WEIGHTS = {"curve": 0.5, "formula": 0.4, "fine": 0.1, "cycle": 0.2, "members": 0.2}
"""Weights of the forms that a curve may have, among the possible ones: mostly the curve itself, or a short formula."""
P_RARE_FORM = 0.1
"""Prior probability of each rarer form of a law: a few steps and ramps; a function of time that is switched on and off;
a law that differs by set-up; a law at one set-up alone, except for the kinds of responses in `P_SINGLE_SET_UP`.
"""
P_SINGLE_SET_UP = {"stand": 0.5}
"""Prior probability that a law acts at one set-up alone, by kind of response: stands differ, instruments do so less.
It is `P_RARE_FORM` for all other kinds.
"""
MAX_MODEL_MEMBERS = 5
"""Largest number of members of a model, of reported findings, and of reported constants of instruments."""
LOG_ODDS_REPEATED = float(np.log(0.03))
"""Log odds of a second effect of a kind that rarely occurs twice (two windows, two unknown laws), relative to any other
second effect.
"""


def log_prior_share(kind: str, n_explanations: int) -> float:
    """Log prior of each of `n_explanations` explanations of a kind of `CAUSE_PRIOR`."""
    return float(np.log(CAUSE_PRIOR[kind] / max(n_explanations, 1)))


def prior_rows() -> Iterator[tuple[str, float]]:
    """Pairs of text and prior probability of every kind of explanation; the probabilities add up to one."""
    for kind, part in CAUSE_PRIOR.items():
        if kind != "law":
            yield CAUSE_TEXTS[kind], part
            continue
        yield from ((f"{CAUSE_TEXTS[kind]}: {where}", part * share) for where, share in PLACE_PRIOR.items())
