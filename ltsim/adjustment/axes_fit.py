"""How stated coordinates fit a network that they only give axes to: each is tested by what the others say.

The fit takes all points alike. What a point misses the axes of the others by is compared with the network's own
uncertainty there and the scatter that the others show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.datum import about, moved_to_datum
from ltsim.adjustment.known import SIGMAS, KnownTest
from ltsim.arrays import Bools, Floats
from ltsim.geometry.alignment import robust_align
from ltsim.geometry.rigid import rigid_motion
from ltsim.recording.recording import Recording
from ltsim.units import MILLIMETRE

GROSS, CLEARLY = 2e-3, 10.0
"""Miss [m], and in medians, of the axes that most points ask for, from which a point begins outside."""
LEVEL = 0.02
"""Chance that any point of a sound fit is left out."""
LEAST = 3
"""Points that define axes."""
OPEN = 1e-6
"""Share of a point's error that its residual shows below which the others say nothing of it."""


@dataclass(frozen=True)
class Axes:
    """The fit of stated coordinates (k, 3) to a network, some of them in `use` (k,)."""

    adjustment: Adjustment
    names: tuple[str, ...]
    stated: Floats
    use: Bools

    @property
    def _chosen(self) -> list[str]:
        return [name for name, used in zip(self.names, self.use, strict=True) if used]

    def tests(self) -> list[KnownTest]:
        """Each point by what the points in use say without it."""
        found = self.adjustment.in_inner_datum(self._chosen)
        at = [found.recording.targets.index(name) for name in self.names]
        state, _ = moved_to_datum(found.problem, found.state, self._chosen)
        turn = state.rotation[0] @ found.state.rotation[0].T
        own = turn @ found.target_covariance[at] @ turn.T
        gap, places = self.stated - state.points[at], state.points[at]
        centre = places[self.use].mean(axis=0)
        free = about(found.problem.free, centre)
        motion = (rigid_motion(places, centre) @ free).reshape(-1, 3, free.shape[1])
        basis = np.linalg.qr(motion[self.use].reshape(-1, motion.shape[2]))[1]
        carried = motion @ np.linalg.inv(basis)
        held = carried @ np.swapaxes(carried, 1, 2)
        square = float(np.sum(gap[self.use] ** 2)) - float(np.trace(own[self.use].sum(axis=0)))
        dof = 3 * int(self.use.sum()) - motion.shape[2]
        return [
            _test(name, gap[k], own[k], held[k], used=bool(self.use[k]), rest=(square, dof, LEVEL / len(self.names)))
            for k, name in enumerate(self.names)
        ]


def _test(
    name: str, gap: Floats, own: Floats, held: Floats, *, used: bool, rest: tuple[float, int, float]
) -> KnownTest:
    """The test of a point off by `gap` (3,): `own` its covariance in the network, `held` what it adds to the axes.

    With R = 1 - `held` of a point in use, its residual is R times its error; another shows its error whole.
    """
    share, turned = np.linalg.eigh(np.eye(3) - held if used else np.eye(3) + held)
    seen = share > OPEN
    turned, share = turned[:, seen], share[seen]
    shown = share if used else np.ones(len(share))
    square, dof, level = rest
    error = turned.T @ gap / shown
    if used:
        square, dof = square - float(share @ error**2) + float(np.trace(own)), dof - len(share)
    scatter = max(square, 0.0) / max(dof, 1)
    network = (turned.T @ own @ turned) / np.outer(shown, shown)
    spread = network + np.diag(scatter / share if used else scatter * share)
    limit = len(share) * special.fdtri(len(share), max(dof, 1), 1.0 - level)
    return KnownTest(
        kind="axes",
        name=name,
        axes="xyz",
        sigma=np.sqrt(np.diag(own) + scatter),
        residual=gap,
        error=turned @ error,
        sigma_error=np.sqrt(np.einsum("ik,kl,il->i", turned, spread, turned)),
        drop=float(error @ np.linalg.solve(spread, error)),
        rank=len(share),
        left_out=not used,
        critical=max(SIGMAS, float(np.sqrt(limit))),
    )


def fitted_axes(adjustment: Adjustment, names: Sequence[str]) -> tuple[Recording, tuple[KnownTest, ...]]:
    """The recording with its datum at the points that agree about the axes, and the test of each point.

    A point that the others contradict is left out; where they alone would leave the axes open, it keeps the part that
    they do not check.
    """
    recording = adjustment.recording
    stated = np.array([recording.target_setup(name).approximate_mm for name in names], dtype=np.float64) * MILLIMETRE
    here = adjustment.state.points[[recording.targets.index(name) for name in names]]
    turn, shift = robust_align(here, stated)
    misses = np.linalg.norm(here @ turn.T + shift - stated, axis=1)
    inside = misses <= max(CLEARLY * float(np.median(misses)), GROSS)
    fit = Axes(adjustment, tuple(names), stated, inside if inside.sum() > len(names) / 2 else inside | True)
    for _ in range(2 * len(names)):
        tests = fit.tests()
        ratio = np.array([test.w / test.critical for test in tests])
        if (~fit.use & (ratio <= 1.0)).any():
            k = int(np.argmin(np.where(fit.use, np.inf, ratio)))
        elif (fit.use & (ratio > 1.0)).any():
            k = int(np.argmax(np.where(fit.use, ratio, 0.0)))
        else:
            break
        if fit.use[k] and fit.use.sum() <= LEAST:
            tests[k] = replace(tests[k], left_out=True)
            fit.stated[k] -= tests[k].error
            break
        fit = replace(fit, use=fit.use ^ (np.arange(len(names)) == k))
    targets = dict(recording.setup.targets)
    for name, used, place in zip(names, fit.use, fit.stated / MILLIMETRE, strict=True):
        targets[name] = targets[name].model_copy(update={"datum": bool(used), "approximate_mm": tuple(place.tolist())})
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets})), tuple(tests)
