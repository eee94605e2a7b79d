"""The prior of a diagnosis: one table of shares, normalised over everything that is looked for.

That something is missing, and that nothing is, start alike. What is missing is shared among kinds of explanations; each
share evenly among all of its kind that a recording offers: effects of the catalogue, their places and shapes, carriers,
drivers and places of laws (each operator of a driver costs
`laws.regressor_library.OPERATOR_ODDS`). `rows` is the table as the theory page
prints it. The numbers are judgements of how often
a cause occurs in service; several were revised after experiments with known causes. A factor of two in one of them is
0.7 of log evidence.
"""

from collections.abc import Iterator

import numpy as np

from ltsim.core.probability import P_CONSTANT

PRIOR = {"named": 0.53, "law": 0.3, "noise": 0.095, "scatter": 0.035, "constant": P_CONSTANT}
"""Prior probability of each kind of unmodelled cause, given that there is one."""
ABOUT = {
    "named": "an effect of the catalogue that shifts readings",
    "law": "an empirical law outside the catalogue",
    "noise": "a change of the noise of the catalogue",
    "scatter": "another variance function of the noise",
    "constant": (
        "a constant of an instrument that contradicts the other instruments, its history or a declared correction"
    ),
}
"""Kinds of `PRIOR` in words."""
P_UNMODELLED = 0.2
"""Share of causes that are in no list, and look like something that is: one in five."""
SAME_OBSERVABLE = 0.5
"""Chance that such a cause acts on the observable of what it looks like."""
P_CAP_TESTS = 1.0 - P_UNMODELLED * SAME_OBSERVABLE
"""Upper limit on the probability reported for findings that have no likelihood term for an unmodelled cause."""
PLACES = {"everywhere": 0.5, "set-up": 0.2, "instrument": 0.1, "target": 0.1, "group": 0.1}
"""Prior probability of each kind of place at which a law outside the catalogue acts."""
KINDS = {
    "reading": 0.5,
    "instrument": 0.17,
    "circle": 0.03,
    "stand": 0.2,
    "target": 0.04,
    "reflector": 0.02,
    "air": 0.04,
}
"""Shares of the kinds of carriers: what errs in no known way shows in a reading alone, and where all targets seem to
move alike it is the stands."""
AT_TARGETS = {"reading": 0.2, "target": 0.8}
"""Shares for causes that act at some targets only: mostly the target itself, for an instrument does not know it."""
FORMS = {"curve": 0.5, "formula": 0.4, "fine": 0.1, "cycle": 0.2, "members": 0.2}
"""Weights of what a curve turns out to be, among those that there are: mostly itself, or a short formula."""
P_PIECEWISE, P_SWITCHED, P_PER_SETUP = 0.1, 0.1, 0.1
"""Shares of curves that are made of a few steps and ramps; of courses in time that are switched on and off; of laws
that every set-up follows in its own way."""
LOG_ODDS_REPEATED = float(np.log(0.03))
"""Log odds of a second effect of a kind that hardly comes twice (two windows, two laws that nobody knows), against any
other second effect."""


def log_share(kind: str, among: int) -> float:
    """Log prior of each of `among` explanations of a kind of `PRIOR`."""
    return float(np.log(PRIOR[kind] / max(among, 1)))


def rows() -> Iterator[tuple[str, float]]:
    """Every kind of explanation in words and its share; the shares sum to one."""
    for kind, part in PRIOR.items():
        if kind != "law":
            yield ABOUT[kind], part
            continue
        yield from ((f"{ABOUT[kind]}: {where}", part * share) for where, share in PLACES.items())
