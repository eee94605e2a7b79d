"""A law in all its forms: the curve, short formulas, steps and ramps, everywhere alike or another at each set-up.

What is scored at once is a rough sight of a law; here the few that stand out are computed exactly.
"""

from dataclasses import replace

import numpy as np

from ltsim.calibration.evidence import log_sum_exp
from ltsim.diagnosis.evidence import TIE, best_of, evidence_with
from ltsim.diagnosis.exact import Exact
from ltsim.diagnosis.hypotheses import Found, Hypothesis
from ltsim.diagnosis.prior import FORMS, OWN_WAY, PIECES
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.names import name_of

MOST_PIECES, PATIENCE = 10, 3
"""Steps and ramps at most, and those that are tried beyond the best."""


def in_all_forms(exact: Exact, law: Law, log_prior: float, base: Found, *, pieces: bool) -> list[Hypothesis]:
    """A law computed exactly in all its forms: of each name the likeliest, with the evidence of all that have it."""
    sightings = exact.space.sightings
    law = law.as_constant(sightings)
    whole = log_prior + float(np.log(len(law.driver.spreads)))
    tried = _in_pieces(exact, law, whole + float(np.log(PIECES)), base) if pieces else []
    whole += float(np.log(1.0 - PIECES)) if tried else 0.0
    each = law.at_each(sightings)
    tried += _forms(exact, law, whole + (np.log(1.0 - OWN_WAY) if each else 0.0), base)
    tried += _forms(exact, each, whole + np.log(OWN_WAY), base) if each else []
    found = []
    for name in {h.name: None for h in tried}:
        alike = [h for h in tried if h.name == name]
        total = float(log_sum_exp(np.array([h.value for h in alike])))
        found.append(replace(alike[best_of(np.array([h.value for h in alike]))], value=total))
    return found


def _forms(exact: Exact, law: Law, prior: float, base: Found) -> list[Hypothesis]:
    """The forms of a law at its place."""
    forms = law.forms(exact.space.sightings)
    whole = sum(FORMS[kind] for kind in forms)
    shares = {kind: prior + float(np.log(FORMS[kind] / whole / len(some))) for kind, some in forms.items()}
    asked = [(shares[kind], scales) for kind, some in forms.items() for scales in some]
    single, several = ([one for one in asked if (len(one[1]) == 1) == alone] for alone in (True, False))
    climbed = exact.uphill([scales[0] for _, scales in single], base)
    found = [(share, *best) for (share, _), best in zip(single, climbed, strict=True)]
    moments = exact.moments([scales[0] for _, scales in several], base)
    for (share, scales), (gram, score) in zip(several, moments, strict=True):
        spreads = np.stack([one.spread for one in scales])
        logs = evidence_with(gram, score[None], spreads)
        found.append((share, scales[best_of(logs)], float(log_sum_exp(logs) - np.log(len(logs)))))
    return [Hypothesis(best, share, value + share, name_of(best)) for share, best, value in found]


def _in_pieces(exact: Exact, law: Law, prior: float, base: Found) -> list[Hypothesis]:
    """The law made of a few steps and ramps, chosen one after another while the evidence rises."""
    atoms = law.atoms(exact.space.sightings)
    if not atoms or len(law.targets) == 1:  # a target that moves, or sits badly, has cards
        return []
    whole = law.in_pieces(atoms)
    gram, score = exact.moments([whole], base)[0]
    spread = whole.spread
    places = np.arange(len(score)).reshape(len(whole.carrier.ways), len(atoms), -1)
    chosen: list[int] = []
    taken, best, price = 0, -np.inf, float(np.log(2 * len(atoms)))  # which one, and that there is a further one
    while len(chosen) < min(taken + PATIENCE, MOST_PIECES, len(atoms)):
        values = np.full(len(atoms), -np.inf)
        free = [i for i in range(len(atoms)) if i not in chosen]
        some = np.stack([places[:, [*chosen, i]].ravel() for i in free])
        values[free] = evidence_with(gram[some[:, :, None], some[:, None, :]], score[some], spread[some])
        chosen.append(best_of(values))
        value = float(log_sum_exp(values)) - len(chosen) * price
        if value > best + TIE:
            best, taken = value, len(chosen)
    found, value = exact.uphill([law.in_pieces([atoms[i] for i in sorted(chosen[:taken])])], base)[0]
    prior -= taken * price
    return [Hypothesis(found, prior, max(best + taken * price, value) + prior, name_of(found))]
