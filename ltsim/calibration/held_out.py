"""Terms that predict worse than going without them: targets are held out one by one, and the rest predicts them.

A target's readings check each other once its place is eliminated. With r their residual (m,) and A (m, K) their design
by poses and parameters, both so reduced, C the covariance of these from all readings, H = A C A' and S = (1 - H)^-1,
the target held out leaves S r; a term fixed at zero changes what the others predict by a rank-one step for each of its
parameters. So all that is needed is m x m and p x p, one adjustment serves for every target and term.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.arrays import Floats, Ints
from ltsim.calibration.amplitude import cosine_and_sine
from ltsim.remedies.undetermined import SILENT
from ltsim.solve.design import as_dense

WORSE = 2.0
"""Sum of squares over the targets held out by which a term has to be worse: what Akaike's criterion asks of one."""
LARGEST = 400
"""Most unknown poses and parameters of a network that is tested."""
MOST_TARGETS = 150
FEWEST = 5
"""Targets that predict each other."""


@dataclass(frozen=True)
class HeldOut:
    """What one target's readings leave when the others predict them."""

    residual: Floats
    """(m,): S r."""
    by_parameter: Floats
    """(m, q): covariance S B' of the prediction with the parameters, B = C A'."""
    covariance: Floats
    """(q, q): of the parameters, from the other targets."""
    shift: Floats
    """(q,): b S r: the estimate from all readings less that from the others."""

    def squares(self, values: Floats, fixed: Ints) -> float:
        """Sum of squares with the parameters `fixed` at zero; `values` (q,) are the estimates from all readings."""
        if not len(fixed):
            return float(self.residual @ self.residual)
        moved = np.linalg.solve(self.covariance[np.ix_(fixed, fixed)], self.shift[fixed] - values[fixed])
        left = self.residual - self.by_parameter[:, fixed] @ moved
        return float(left @ left)


def unheld(adjustment: Adjustment) -> Ints:
    """Places, in the flat vector of parameters (I p), of those that targets are better predicted without.

    The term that is worst is taken away first, then the next, as long as that helps. None in a network that is large
    or has few targets.
    """
    none = np.zeros(0, dtype=np.int64)
    unknowns = adjustment.problem.unknowns
    if unknowns.kept > LARGEST:
        return none
    targets = held_out_targets(adjustment)
    if len(targets) < FEWEST:
        return none
    values = adjustment.state.instrument.ravel()
    gone, now = none, sum(t.squares(values, none) for t in targets)
    candidates = _terms(adjustment)
    while candidates:
        tried = [np.concatenate([gone, term]) for term in candidates]
        after = [sum(t.squares(values, fixed) for t in targets) for fixed in tried]
        best = int(np.argmin(after))
        if now - after[best] <= WORSE:
            break
        gone, now = tried[best], after[best]
        del candidates[best]
    return np.sort(gone)


def _terms(adjustment: Adjustment) -> list[Ints]:
    """Places of each term: a cosine and its sine, or a parameter; of what was estimated and the readings tell of."""
    prior, at = adjustment.problem.prior, adjustment.problem.unknowns.instrument.ravel()
    left = np.diag(adjustment.kept_covariance)[at] / prior.sigma.ravel() ** 2
    open_ = ~prior.held.ravel() & (left < 1.0 - SILENT)
    sines = {i: j for _, i, j in cosine_and_sine(adjustment.construction.names)}
    each = [[k, sines[k]] if k in sines else [k] for k in range(prior.mean.shape[1]) if k not in sines.values()]
    terms = [[i * prior.mean.shape[1] + k for k in term] for i in range(len(prior.mean)) for term in each]
    chosen = [[k for k in term if open_[k]] for term in terms]
    return [np.array(term, dtype=np.int64) for term in chosen if term]


def held_out_targets(adjustment: Adjustment) -> list[HeldOut]:
    """Every target whose readings check each other and whose place is an unknown of its own, held out."""
    problem, unknowns = adjustment.problem, adjustment.problem.unknowns
    system, kept = adjustment.solution.system, adjustment.problem.unknowns.kept
    row_target = adjustment.recording.target[np.nonzero(problem.use)[0]]
    own = np.flatnonzero(unknowns.target[:, 0] >= kept)
    own = own[:: max(1, -(-len(own) // MOST_TARGETS))]
    found = []
    for target in own.tolist():
        rows = np.flatnonzero(row_target == target)
        if len(rows) > 3:
            design = as_dense(system.design[rows])
            reduced = _without(design[:, unknowns.target[target]], design[:, :kept], system.residual[rows])
            found.append(_held_out(adjustment, *reduced))
    return found


def _without(place: Floats, design: Floats, residual: Floats) -> tuple[Floats, Floats]:
    """Design (m, K) and residual (m,) of a target's rows with its place (m, 3) eliminated."""
    basis = np.linalg.qr(place)[0]
    return design - basis @ (basis.T @ design), residual - basis @ (basis.T @ residual)


def _held_out(adjustment: Adjustment, design: Floats, residual: Floats) -> HeldOut:
    covariance, at = adjustment.kept_covariance, adjustment.problem.unknowns.instrument.ravel()
    spread = covariance @ design.T
    alone = np.linalg.inv(np.eye(len(residual)) - design @ spread)
    by_parameter = alone @ spread[at].T
    own = covariance[np.ix_(at, at)] + spread[at] @ by_parameter
    left = alone @ residual
    return HeldOut(left, by_parameter, own, spread[at] @ left)
