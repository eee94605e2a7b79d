"""Did points move between two recordings? The congruence test, and which points moved.

Each epoch is adjusted by itself; the second is brought onto the first by the rigid motions that one of them leaves open
(and a scale, if asked for). What remains is compared with the full covariance of both. Points that moved are found one
by one: whichever explains most of what is left, until the rest is congruent; each is then tested beside the others.

References
----------
Pelzer, Zur Analyse geodaetischer Deformationsmessungen (1971): the congruence test.
Baarda, A testing procedure for use in geodetic networks (1968): the single hypotheses and their smallest visible size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy import special

from ltsim.adjust.adjustment import Adjustment
from ltsim.adjust.reliability import noncentrality
from ltsim.arrays import Bools, Floats, Ints
from ltsim.chances import p_is
from ltsim.errors import ModelError, NetworkError, unknown_name
from ltsim.geometry.alignment import align
from ltsim.geometry.rigid import rigid_motion
from ltsim.notebook import Columns, Shown
from ltsim.recording.lengths import COEFFICIENT
from ltsim.recording.setup import Gauge
from ltsim.uncertainty.inputs import CONTROL, LENGTHS, PRIORS, observed_sources, reach_of
from ltsim.units import MICROMETRE

AXES = tuple(enumerate("xyz"))
ALIGNING = 6


@dataclass(frozen=True)
class Displacement:
    """What one point did."""

    target: str
    shift: Floats
    """(3,) [m]: from the first epoch to the second, in the frame that the stable points hold."""
    covariance: Floats
    """(3, 3) [m^2]."""
    p_value: float
    """Of the hypothesis that this point alone did not move, the other moved ones apart."""
    moved: bool
    least: float
    """[m]: the smallest motion, in its best direction, that is found with 80 %; `surely` in its worst."""
    surely: float
    """[m]."""

    @property
    def size(self) -> float:
        """Length of the shift [m]."""
        return float(np.linalg.norm(self.shift))

    def semi_axes(self, coverage: float = 0.95) -> Floats:
        """Semi-axes (3,) [m] of the ellipsoid that holds the true shift with a probability, largest first."""
        factor = float(2.0 * special.gammaincinv(1.5, coverage))
        return np.sqrt(factor * np.clip(np.linalg.eigvalsh(self.covariance), 0.0, None))[::-1]


@dataclass(frozen=True, repr=False)
class Congruence(Shown):
    """Two epochs compared."""

    statistic: float
    dof: int
    p_value: float
    """Global test: no point moved. Chi-square under the stated noise."""
    after: float
    """P-value of the same test without the points that moved."""
    level: float
    """False-alarm rate over all points together."""
    displacements: tuple[Displacement, ...]
    """Of every common point, in the order of the first recording."""
    scale: float | None
    """Scale of the second epoch less 1, where it was estimated."""

    def _lines(self) -> list[str]:
        return [self.sentence, f"no motion at all: {p_is(self.p_value)}; without what moved: {p_is(self.after)}"]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"displacements": self._displacements}

    def _displacements(self) -> Columns:
        shift = np.array([d.shift for d in self.displacements]) / MICROMETRE
        sigma = np.array([np.sqrt(np.diag(d.covariance)) for d in self.displacements]) / MICROMETRE
        named = {f"{what}{axis}_um": list(v[:, i]) for what, v in (("d", shift), ("s", sigma)) for i, axis in AXES}
        return {
            "target": [d.target for d in self.displacements],
            "moved": [d.moved for d in self.displacements],
            **named,
            "p_value": [d.p_value for d in self.displacements],
            "visible_um": [d.surely / MICROMETRE for d in self.displacements],
        }

    @property
    def moved(self) -> tuple[str, ...]:
        """Names of the points that moved."""
        return tuple(d.target for d in self.displacements if d.moved)

    @property
    def sentence(self) -> str:
        """The verdict."""
        told = [d for d in self.displacements if d.moved]
        if not told:
            sure = max(d.surely for d in self.displacements)
            return f"no point moved; a motion of {1e6 * sure:.0f} um would have been found anywhere in 4 of 5 cases"
        worst = sorted(told, key=lambda d: -d.size)
        names = ", ".join(f"{d.target} by {1e6 * d.size:.0f} um" for d in worst[:6])
        more = f" and {len(worst) - 6} more" if len(worst) > 6 else ""
        return f"{len(told)} of {len(self.displacements)} points moved: {names}{more}"


@dataclass(frozen=True)
class _Gap:
    """Differences d (3 T,) of common points after alignment, their covariance, and motions (3 T, f) that are free."""

    gap: Floats
    covariance: Floats
    free: Floats

    @cached_property
    def _root(self) -> Floats:
        scale = np.sqrt(np.diag(self.covariance))
        unit = self.covariance / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(unit)
        # Directions that neither epoch measured at all say nothing.
        keep = values > 1e-12 * values[-1]
        return (vectors[:, keep] / np.sqrt(values[keep])).T / scale

    def cost(self, columns: Floats | None = None) -> float:
        """Weighted sum of squares of what free motions and further columns (3 T, q) do not explain."""
        left = self._root @ self.gap
        design = self._root @ (self.free if columns is None else np.hstack([self.free, columns]))
        basis = scipy.linalg.orth(design / np.linalg.norm(design, axis=0))
        return float(left @ left - np.sum((basis.T @ left) ** 2))

    def estimate(self, columns: Floats) -> tuple[Floats, Floats]:
        """Values of free motions and further columns, and their covariance."""
        design = self._root @ np.hstack([self.free, columns])
        size = np.linalg.norm(design, axis=0)
        inverse = np.linalg.pinv(design / size) / size[:, None]
        return inverse @ (self._root @ self.gap), inverse @ inverse.T

    @property
    def dof(self) -> int:
        """Degrees of freedom of the global test."""
        return len(self._root) - self.free.shape[1]


def compare(
    first: Adjustment,
    second: Adjustment,
    *,
    stable: Sequence[str] | None = None,
    scaled: bool = False,
    same_instrument: bool = False,
    level: float = 0.05,
) -> Congruence:
    """Compare the points that two converged adjustments share, each in its own frame; options as of `ltsim.compare`.

    Raises
    ------
    ModelError
        When a stable point is not common.
    NetworkError
        When too few points are common.
    """
    lost = {*first.lost_targets, *second.lost_targets}
    common = [n for n in first.recording.targets if n in second.recording.targets and n not in lost]
    for name in stable or ():
        if name not in common:
            raise unknown_name("common point", name, common)
    if len(common) < 4:
        raise NetworkError(f"the recordings share {len(common)} points; at least 4 are needed to see one of them move")
    if stable is not None and len(stable) < 3:
        raise ModelError(f"{len(stable)} stable points hold no frame; name at least 3")
    at = [np.array([a.recording.targets.index(n) for n in common]) for a in (first, second)]
    known = np.array([stable is None or name in stable for name in common])
    given = _in_common(first, second, same_instrument)
    one, other = (_Epoch.of(a, i, given) for a, i in zip((first, second), at, strict=True))
    gap = _aligned(one, other, scaled, known)
    tested = np.flatnonzero(~known) if stable is not None else np.arange(len(common))
    moved = _search(gap, tested, level, 3 * len(common))
    return _told(gap, common, moved, known if stable is not None else np.zeros(len(common), dtype=bool), scaled, level)


@dataclass(frozen=True)
class _Epoch:
    """Points (T, 3) of one epoch, their joint covariance (3 T, 3 T), and the rigid motions (6, f) that are open.

    `by_given` (3 T, g) is how the points follow what the epochs may have in common, in standard deviations.
    """

    points: Floats
    covariance: Floats
    by_given: Floats
    free: Floats

    @classmethod
    def of(cls, adjustment: Adjustment, at: Ints, common: Sequence[str]) -> _Epoch:
        reach = reach_of(adjustment, at)
        groups = {source.name: source.response for source in observed_sources(adjustment, reach)}
        given = [np.zeros((reach.shape[1], 0)), *(groups[name] for name in common if name in groups)]
        return cls(adjustment.state.points[at], reach.T @ reach, np.hstack(given), adjustment.problem.free)


def _in_common(first: Adjustment, second: Adjustment, same_instrument: bool) -> list[str]:
    """Groups of observations that are the same ones in both epochs, errors included: equal statements."""
    one, other = first.recording.setup, second.recording.setup
    common = []
    if same_instrument:
        if first.problem.prior_sigma.shape != second.problem.prior_sigma.shape:
            raise ModelError("the recordings hold different numbers of instruments, they cannot be the same one")
        common.append(PRIORS)
    if one.gauge is not None and other.gauge is not None and _certificate(one.gauge) == _certificate(other.gauge):
        shared = [a.problem.gauge.shared for a in (first, second)]
        common += [LENGTHS, *(name for name in shared[0] if name in shared[1] and name.startswith(COEFFICIENT))]
    known = [
        {name: t.known_mm for name, t in setup.targets.items() if t.known_mm is not None} for setup in (one, other)
    ]
    if known[0] and known[0] == known[1]:
        common.append(CONTROL)
    return common


def _certificate(gauge: Gauge) -> Gauge:
    """What was known of the lengths before they were used: not how warm they were then."""
    plain = {"measured_at_c": None, "sigma_temperature_k": None}
    lengths = tuple(line.model_copy(update=plain) for line in gauge.distance)
    return gauge.model_copy(update={"measured_at_c": 0.0, "sigma_temperature_k": None, "distance": lengths})


def _aligned(first: _Epoch, second: _Epoch, scaled: bool, known: Bools) -> _Gap:
    """The second epoch moved onto the first; where both frames are held, as they are."""
    one, other, turn = first.points, second.points, np.eye(3)
    middle = one[known].mean(axis=0)
    both = np.hstack([first.free, second.free])
    free = scipy.linalg.orth(both) if both.shape[1] else both
    if free.shape[1]:
        weights = known.astype(np.float64)
        for _ in range(ALIGNING):
            turn, shift = align(second.points, one, weights)
            other = second.points @ turn.T + shift
            off = np.linalg.norm(other - one, axis=1)
            weights = known / (off + np.median(off[known]) + 1e-12)  # A point that moved must not turn the rest.
    big = np.kron(np.eye(len(one)), turn)
    shared = first.by_given @ second.by_given.T @ big.T
    covariance = first.covariance + big @ second.covariance @ big.T - shared - shared.T
    motions = rigid_motion(one, middle)
    motions = motions @ _about(free, middle) if free.shape[1] else motions[:, :0]
    if scaled:
        motions = np.hstack([motions, (one - middle).reshape(-1, 1)])
    return _Gap((other - one).ravel(), covariance, motions)


def _about(free: Floats, centre: Floats) -> Floats:
    """Motions (6, f) with their turns about a centre instead of the origin."""
    about = free.copy()
    about[:3] += np.cross(free[3:].T, centre).T
    return about


def _columns(points: Sequence[int] | Ints, size: int) -> Floats:
    """Unit displacements (3 T, 3 k) of some points."""
    columns = np.zeros((size, 3 * len(points)))
    for j, point in enumerate(points):
        columns[3 * point : 3 * point + 3, 3 * j : 3 * j + 3] = np.eye(3)
    return columns


def _search(gap: _Gap, tested: Ints, level: float, size: int) -> list[int]:
    """Points that moved: added while one stands out, then each tested again beside the others."""
    moved: list[int] = []
    limit = special.chdtri(3, level / max(len(tested), 1))
    most = max(0, (size // 3) - 3)
    while len(moved) < min(len(tested), most):
        now = gap.cost(_columns(moved, size))
        rest = [p for p in tested if p not in moved]
        drops = [now - gap.cost(_columns([*moved, p], size)) for p in rest]
        best = int(np.argmax(drops))
        if drops[best] < limit:
            break
        moved.append(int(rest[best]))
    for point in list(moved):
        others = [p for p in moved if p != point]
        if gap.cost(_columns(others, size)) - gap.cost(_columns(moved, size)) < limit:
            moved = others
    return moved


def _told(gap: _Gap, names: Sequence[str], moved: list[int], fixed: Bools, scaled: bool, level: float) -> Congruence:
    """Displacements of all points in the frame that the unmoved ones hold, and the tests."""
    size = 3 * len(names)
    count = max(int(np.sum(~fixed)), 1)
    needed = noncentrality(3, level=level / count)
    rest = gap.cost(_columns(moved, size))
    displacements = []
    for i, name in enumerate(names):
        free = [*[p for p in moved if p != i], i]
        values, covariance = gap.estimate(_columns(free, size))
        own = covariance[-3:, -3:]
        drop = gap.cost(_columns(free[:-1], size)) - gap.cost(_columns(free, size))
        spread = np.sqrt(needed * np.clip(np.linalg.eigvalsh(own), 0.0, None))
        p = float(min(1.0, count * special.chdtrc(3, max(drop, 0.0))))
        displacements.append(Displacement(name, values[-3:], own, p, i in moved, float(spread[0]), float(spread[-1])))
    values, _ = gap.estimate(_columns(moved, size))
    dof = gap.dof
    return Congruence(
        statistic=gap.cost(),
        dof=dof,
        p_value=float(special.chdtrc(dof, max(gap.cost(), 0.0))),
        after=float(special.chdtrc(dof - 3 * len(moved), max(rest, 0.0))),
        level=level,
        displacements=tuple(displacements),
        scale=float(values[gap.free.shape[1] - 1]) if scaled else None,
    )
