"""Tolerances of points: limits of their errors, layouts that keep them, and those that remain after a loss."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.core.notation import listing
from ltsim.core.units import MILLIMETRE
from ltsim.physics.model.construction import Construction
from ltsim.planning.information import LayoutInformation
from ltsim.planning.rules import BrokenRule, words_of
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey

LOOSE = 10.0
"""Points without a tolerance count as if theirs were so many times the widest one."""
LEAST_WEIGHT = 1e-6
MOST_NAMED = 5
SIGHT = "the sight"
"""First words of the name of a lost sight."""
APART = "the network falls apart"
"""Description of a network that no longer determines its points."""


def keeps(ratio: float) -> bool:
    """True where an error keeps its tolerance: `ratio` is the error over the tolerance, neither of them rounded."""
    return ratio <= 1.0


def against(value: float, limit: float, digits: int = 3) -> str:
    """A value with the fewest digits, from `digits` on, that show on which side of its limit it is."""
    texts = (f"{value:.{count}g}" for count in range(digits, 17))
    return next((text for text in texts if (float(text) > limit) == (value > limit)), repr(value))


def percent(ratio: float) -> str:
    """An error over its tolerance in per cent: `100.4 %` for one that is 0.4 % too large."""
    return f"{against(100.0 * ratio, 100.0)} %"


@dataclass(frozen=True)
class Demands:
    """Tolerances that points must keep."""

    tolerance: Mapping[str, float]
    """[m]: by point."""
    level: float = 0.95
    """Share of cases in which a point must be within."""
    robust: str = "no"
    """`no`, or which loss must not break a tolerance: `sight`, `station`."""

    @classmethod
    def of(cls, file: PlanFile) -> Demands:
        """Demands of a plan file: a point's own tolerance, else the tightest that names its group or all."""
        found = {}
        for point in file.listed:
            named = [t.within_mm for t in file.goal.tolerances if t.group in ("", point.group)]
            own = point.tolerance_mm if point.tolerance_mm is not None else min(named, default=None)
            if own is not None:
                found[point.name] = own * MILLIMETRE
        return cls(found, file.goal.level_pct / 100.0, file.goal.robust)

    def __bool__(self) -> bool:
        return bool(self.tolerance)


def importance(file: PlanFile) -> dict[str, float]:
    """Weights of a plan's points: their own, over the squares of their tolerances."""
    demands = Demands.of(file)
    if not demands:
        return {p.name: max(p.weight, LEAST_WEIGHT) for p in file.listed if p.weight != 1.0}
    tight, wide = min(demands.tolerance.values()), LOOSE * max(demands.tolerance.values())
    return {
        p.name: max(p.weight * (tight / demands.tolerance.get(p.name, wide)) ** 2, LEAST_WEIGHT) for p in file.listed
    }


def radius(covariance: Floats, level: float) -> Floats:
    """Distance (T,) that the errors of points with covariances (T, 3, 3) keep within in a share `level` of cases.

    The squared length of a normal error is a weighted sum of chi-squares; its quantile is that of the scaled chi-square
    with the same mean and variance (Satterthwaite, Biometrics Bulletin 2 (1946) 110-114), which is exact for errors
    along one axis, in a plane alike and in space alike.
    """
    mean = np.einsum("tii->t", covariance)
    square = np.einsum("tij,tji->t", covariance, covariance)
    freedom = np.where(square > 0, mean**2 / np.where(square > 0, square, 1.0), 1.0)
    return np.sqrt(mean / freedom * 2.0 * gammaincinv(0.5 * freedom, level))


@dataclass(frozen=True)
class Kept:
    """A layout against its demands."""

    lost: str
    """Lost station or sight; empty for the whole layout."""
    tolerance: Mapping[str, float]
    """[m]: by point."""
    radius: Mapping[str, float]
    """[m]: of the points that have a tolerance and a place."""
    ratio: float
    """Largest radius over tolerance; infinite where a point is not determined."""
    worst: str
    """The point with that ratio."""
    unseen: tuple[str, ...] = ()
    """Points with a tolerance that have no place any more."""

    @property
    def good(self) -> bool:
        """All tolerances are kept."""
        return keeps(self.ratio)

    @property
    def of_sight(self) -> bool:
        """A sight is lost, not a station."""
        return self.lost.startswith(SIGHT)

    @property
    def over(self) -> list[str]:
        """Points with a place whose errors are too large."""
        return [name for name in self.radius if not keeps(self.used(name))]

    def used(self, name: str) -> float:
        """Error of a point over its tolerance."""
        return self.radius[name] / self.tolerance[name]

    @property
    def worst_words(self) -> str:
        """The worst point with its numbers."""
        return self.numbers(self.worst) if self.worst in self.radius else self.worst

    @property
    def worst_point(self) -> str:
        """The worst point with its margin, or how far it is missed, where there is one."""
        excess = 100 * (self.ratio - 1)
        margin = f"margin {-excess:.0f} %" if self.good else f"{excess:{'.0f' if excess >= 1 else '.1g'}} % too large"
        margin = margin if np.isfinite(excess) else "seen from nowhere"
        return f"worst {self.worst_words} ({margin})" if self.radius else APART

    @property
    def remains(self) -> str:
        """Tolerances that remain, in words."""
        if self.good:
            return f"all tolerances hold; {self.worst_words} comes nearest"
        verb, named = "is" if len(self.unseen) == 1 else "are", listing(self.unseen, MOST_NAMED)
        found = [f"{named} {verb} seen from nowhere"] if self.unseen else []
        if not self.radius:
            found.append(APART)
        if self.over:
            worst = max(self.over, key=self.used)
            others = f", {len(self.over) - 1} more too" if len(self.over) > 1 else ""
            found.append(f"{self.numbers(worst)} is too large{others}")
        return ", ".join(found)

    def numbers(self, name: str) -> str:
        """A point with its error and its tolerance."""
        error, tolerance = self.radius[name] / MILLIMETRE, self.tolerance[name] / MILLIMETRE
        return f"{name} with {against(error, tolerance)} of {tolerance:.6g} mm"


def judged(survey: Survey, demands: Demands, built: Construction, lost: str = "") -> Kept:
    """Survey against its demands; points that no station sees are left out of the network and named."""
    seen: Bools = np.asarray(survey.seen.any(axis=0))
    unseen = tuple(n for n, s in zip(survey.target_names, seen, strict=True) if not s and n in demands.tolerance)
    try:
        if not seen.any():
            raise NetworkError("no station sees a target")
        information = LayoutInformation.of(survey.only(seen), built)
    except NetworkError:
        return Kept(lost, demands.tolerance, {}, np.inf, "", unseen)
    names = information.survey.target_names
    every = dict(zip(names, radius(information.target_covariance, demands.level).tolist(), strict=True))
    found = {name: every[name] for name in demands.tolerance if name in every}
    ratios = {name: value / demands.tolerance[name] for name, value in found.items()}
    worst = unseen[0] if unseen else max(ratios, key=lambda name: ratios[name], default="")
    return Kept(lost, demands.tolerance, found, np.inf if unseen or not ratios else ratios[worst], worst, unseen)


def after_losses(survey: Survey, demands: Demands, built: Construction, kind: str) -> Iterator[Kept]:
    """Survey against its demands without each station in turn (`station`), or each sight of a point (`sight`)."""
    if kind == "station":
        for s, name in enumerate(survey.station_names):
            yield judged(survey.without(s), demands, built, name)
        return
    for s, t in np.argwhere(survey.seen).tolist():
        # A sight of a point without a tolerance is one of many that hold the network.
        if survey.target_names[t] in demands.tolerance:
            seen = survey.seen.copy()
            seen[s, t] = False
            name = f"{SIGHT} from {survey.station_names[s]} to {survey.target_names[t]}"
            yield judged(survey.replace(seen=seen), demands, built, name)


def every_loss(survey: Survey, demands: Demands, built: Construction) -> tuple[Kept, ...]:
    """Survey against its demands without each station, then without each sight of a point with a tolerance."""
    kinds = ("station", "sight") if demands else ()
    return tuple(kept for kind in kinds for kept in after_losses(survey, demands, built, kind))


def losses_of(survey: Survey, demands: Demands, built: Construction) -> list[Kept]:
    """Survey without each station, and without each sight where the demands are robust to that: input of a verdict."""
    kinds = ("station", "sight") if demands.robust == "sight" else ("station",)
    return [loss for kind in kinds for loss in after_losses(survey, demands, built, kind)]


def holds(survey: Survey, demands: Demands, built: Construction) -> tuple[bool, float]:
    """True where a survey keeps its demands, after any one loss too where they ask so; and the largest ratio."""
    own = judged(survey, demands, built)
    if not own.good or demands.robust == "no":
        return own.good, own.ratio
    worst = max(kept.ratio for kept in after_losses(survey, demands, built, demands.robust))
    return keeps(worst), worst


@dataclass(frozen=True)
class PlanVerdict:
    """A layout against the rules of its plan and its tolerances: the same for search, move, board and page."""

    reached: bool
    """No rule is broken and all tolerances are kept, after any one loss too where that is asked for."""
    words: str
    """It in a sentence without its full stop."""


def verdict(demands: Demands, kept: Kept, losses: Sequence[Kept], broken: Sequence[BrokenRule] = ()) -> PlanVerdict:
    """Reached or not, broken rules, the worst point and its margin, and the worst of it with any one station lost."""
    asked = [loss for loss in losses if demands.robust == ("sight" if loss.of_sight else "station")]
    reached = not broken and kept.good and all(loss.good for loss in asked)
    count = len(demands.tolerance)
    what = f"all {count}" if kept.good else f"{len(kept.radius) - len(kept.over)} of {count}"
    words = f"{what} tolerances kept at {100 * demands.level:g} %, {kept.worst_point}"
    worst = max((loss for loss in losses if not loss.of_sight), key=lambda loss: loss.ratio, default=None)
    if worst is not None:
        lost = "all kept too" if worst.good else f"not kept without {worst.lost}"
        words += f"; with any one station lost {lost}, {worst.worst_point}"
    rules = f"the layout breaks a rule ({words_of(broken)}); " if broken else ""
    return PlanVerdict(reached, f"{'Reached' if reached else 'Not reached'}: {rules}{words}")


def sentences(losses: Sequence[Kept]) -> list[str]:
    """Sentences on the tolerances that remain when a station or a sight is lost."""
    found = [f"Without {loss.lost} {loss.remains}." for loss in losses if not loss.of_sight]
    sights = [loss for loss in losses if loss.of_sight]
    broken = sorted((loss for loss in sights if not loss.good), key=lambda loss: -loss.ratio)
    if broken:
        more = f", and {len(broken) - 1} more of {len(sights)}" if len(broken) > 1 else f", alone of {len(sights)}"
        found.append(f"Blocking {broken[0].lost} breaks a tolerance ({broken[0].remains}){more}.")
    elif sights:
        found.append(f"Any one of {len(sights)} sights of these points may be blocked: the tolerances hold.")
    return found
