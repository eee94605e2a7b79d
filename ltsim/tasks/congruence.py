"""The congruence test: which of several differences chance does not explain.

References
----------
Pelzer, Zur Analyse geodaetischer Deformationsmessungen (1971): the congruence test.
Baarda, A testing procedure for use in geodetic networks (1968): the single hypotheses and their smallest visible size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
from scipy import special

from ltsim.adjustment.reliability import noncentrality
from ltsim.arrays import Bools, Floats, Ints
from ltsim.chances import p_is
from ltsim.recording.result_file import SourceEntry
from ltsim.results import Column, Result, Table, numbers
from ltsim.saved import Valued
from ltsim.units import MICROMETRE, MILLIMETRE

DISPLACEMENTS = Table(
    "displacements.csv",
    "what every common point did from the first epoch to the second",
    (
        Column("target", "name", "text"),
        Column("moved", "True where it moved", "flag"),
        *numbers(".4f", x_mm="place in the first epoch", y_mm="as x_mm", z_mm="as x_mm"),
        *(Column(f"d{a}_um", "displacement, second less first epoch", sigma=f"s{a}_um") for a in "xyz"),
        *(Column(f"s{a}_um", f"standard deviation of d{a}_um") for a in "xyz"),
        *numbers("", ".1f", a_um="semi-axes of its 95 % ellipsoid", b_um="as a_um", c_um="as a_um"),
        Column("p_value", "that it did not move, paid for all points tested", "chance"),
        Column("visible_um", "smallest motion that is found in 4 of 5 cases, whatever its direction", shown=".0f"),
    ),
)


@dataclass(frozen=True)
class Displacement(Valued):
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
    own: float = np.nan
    """Chi-square of the point's own difference, whatever the others did; NaN where they hold the frame."""
    axes: int = 3
    """Number of axes along which the points are known."""
    place: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) [m]: in the first epoch."""

    @property
    def row(self) -> list[Any]:
        """Its row of `DISPLACEMENTS`."""
        sizes = self.shift, np.sqrt(np.diag(self.covariance)), self.semi_axes()
        shown = [float(v / MICROMETRE) for part in sizes for v in part]
        places = (self.place / MILLIMETRE).tolist()
        return [self.target, self.moved, *places, *shown, self.p_value, self.surely / MICROMETRE]

    @property
    def size(self) -> float:
        """Length of the shift [m]."""
        return float(np.linalg.norm(self.shift))

    def semi_axes(self, coverage: float = 0.95) -> Floats:
        """Semi-axes (3,) [m] of the ellipsoid that holds the true shift with a probability, largest first."""
        factor = float(2.0 * special.gammaincinv(0.5 * self.axes, coverage))
        return np.sqrt(factor * np.clip(np.linalg.eigvalsh(self.covariance), 0.0, None))[::-1]


@dataclass(frozen=True, repr=False)
class Congruence(Result):
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
    first: SourceEntry | None = None
    second: SourceEntry | None = None
    """What was compared."""

    def _lines(self) -> list[str]:
        return [self.sentence, f"no motion at all: {p_is(self.p_value)}; without what moved: {p_is(self.after)}"]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {"displacements": lambda: DISPLACEMENTS.filled(d.row for d in self.displacements)}

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


def rows_of(points: Sequence[int] | Ints, axes: int) -> Ints:
    """Rows (a k,) of some points (k,) among coordinates along a axes, point by point."""
    return (axes * np.asarray(points, dtype=np.int64)[:, None] + np.arange(axes)).ravel()


@dataclass(frozen=True)
class Gap:
    """Differences d (T a,) of common points after alignment along `axes` (a,), their covariance, free motions (T a, f).

    What is added to the covariance along the free motions changes nothing, and makes that of a datum of its own whole.
    """

    gap: Floats
    covariance: Floats
    free: Floats
    axes: Ints
    places: Floats
    """(T, 3) [m]: in the first epoch."""

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.gap) // len(self.axes)

    def columns(self, points: Sequence[int] | Ints) -> Floats:
        """Unit displacements (T a, a k) of some points."""
        return np.eye(len(self.gap))[:, rows_of(points, len(self.axes))]

    def own(self, point: int) -> float:
        """Chi-square of one point's difference by itself; NaN where the frame is free."""
        if self.free.shape[1]:
            return np.nan
        at = rows_of([point], len(self.axes))
        return float(self.gap[at] @ np.linalg.solve(self.covariance[np.ix_(at, at)], self.gap[at]))

    @cached_property
    def _root(self) -> Floats:
        scale = np.sqrt(np.diag(self.covariance))
        unit = self.covariance / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(unit)
        # Directions that neither epoch measured at all say nothing.
        keep = values > 1e-12 * values[-1]
        return (vectors[:, keep] / np.sqrt(values[keep])).T / scale

    def cost(self, columns: Floats | None = None) -> float:
        """Weighted sum of squares of what free motions and further columns (T a, q) do not explain."""
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


def judged(gap: Gap, common: Sequence[str], fixed: Bools, scaled: bool, level: float) -> Congruence:
    """The search among the common points that are not `fixed`, known to be stable."""
    moved = _search(gap, np.flatnonzero(~fixed), level)
    return _told(gap, common, moved, fixed, scaled, level)


def _search(gap: Gap, tested: Ints, level: float) -> list[int]:
    """Points that moved: added while one stands out, then each tested again beside the others."""
    moved: list[int] = []
    limit = special.chdtri(len(gap.axes), level / max(len(tested), 1))
    most = max(0, gap.count - (len(gap.axes) if gap.free.shape[1] else 0))
    while len(moved) < min(len(tested), most):
        now = gap.cost(gap.columns(moved))
        rest = [p for p in tested if p not in moved]
        drops = [now - gap.cost(gap.columns([*moved, p])) for p in rest]
        best = int(np.argmax(drops))
        if drops[best] < limit:
            break
        moved.append(int(rest[best]))
    for point in list(moved):
        others = [p for p in moved if p != point]
        if gap.cost(gap.columns(others)) - gap.cost(gap.columns(moved)) < limit:
            moved = others
    return moved


def _told(gap: Gap, names: Sequence[str], moved: list[int], fixed: Bools, scaled: bool, level: float) -> Congruence:
    """Displacements of all points in the frame that the unmoved ones hold, and the tests."""
    count, a = max(int(np.sum(~fixed)), 1), len(gap.axes)
    needed = noncentrality(a, level=level / count)
    rest = gap.cost(gap.columns(moved))
    displacements = []
    for i, name in enumerate(names):
        free = [*[p for p in moved if p != i], i]
        values, joint = gap.estimate(gap.columns(free))
        drop = gap.cost(gap.columns(free[:-1])) - gap.cost(gap.columns(free))
        spread = np.sqrt(needed * np.clip(np.linalg.eigvalsh(joint[-a:, -a:]), 0.0, None))
        p = float(min(1.0, count * special.chdtrc(a, max(drop, 0.0))))
        shift, covariance = np.zeros(3), np.zeros((3, 3))
        shift[gap.axes], covariance[np.ix_(gap.axes, gap.axes)] = values[-a:], joint[-a:, -a:]
        sizes = float(spread[0]), float(spread[-1])
        displacements.append(Displacement(name, shift, covariance, p, i in moved, *sizes, gap.own(i), a, gap.places[i]))
    values, _ = gap.estimate(gap.columns(moved))
    dof = gap.dof
    return Congruence(
        statistic=gap.cost(),
        dof=dof,
        p_value=float(special.chdtrc(dof, max(gap.cost(), 0.0))),
        after=float(special.chdtrc(dof - a * len(moved), max(rest, 0.0))) if dof > a * len(moved) else 1.0,
        level=level,
        displacements=tuple(displacements),
        scale=float(values[gap.free.shape[1] - 1]) if scaled else None,
    )
