"""Tolerances of points: limits of their errors, checks of a layout, checks after the loss of a station or sight."""

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
from ltsim.planning.site import BrokenRule, words_of
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey

DEFAULT_TOLERANCE_FACTOR = 10.0
"""Factor on the widest tolerance that gives the tolerance of points without one in the objective."""
MIN_WEIGHT = 1e-6
MAX_NAMED = 5
SIGHT = "the sight"
"""First words of the name of a lost sight."""
UNDETERMINED = "the network no longer determines its points"
"""Text for a network with undetermined motions."""


def is_met(ratio: float) -> bool:
    """True if an error meets its tolerance; `ratio` is the unrounded error divided by the unrounded tolerance."""
    return ratio <= 1.0


def text_near_limit(value: float, limit: float, digits: int = 3) -> str:
    """Text of a value with the fewest digits (at least `digits`) that show on which side of its limit it is."""
    texts = (f"{value:.{count}g}" for count in range(digits, 17))
    return next((text for text in texts if (float(text) > limit) == (value > limit)), repr(value))


def percent(ratio: float) -> str:
    """Ratio of error to tolerance as text: `100.4 %` for one that is 0.4 % too large."""
    return f"{text_near_limit(100.0 * ratio, 100.0)} %"


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of points, their confidence level, and the loss after which they must be met."""

    tolerance: Mapping[str, float]
    """Tolerance of each point [m], by name."""
    level: float = 0.95
    """Confidence level: fraction of cases in which a point must be within its tolerance."""
    robust: str = "no"
    """Loss after which all tolerances must still be met: `sight` or `station`; `no` for none."""

    @classmethod
    def of(cls, file: PlanFile) -> Tolerances:
        """Tolerances of a plan file: that of the point, else the smallest one of its group or of all points."""
        limits = {}
        for point in file.listed:
            named = [t.within_mm for t in file.goal.tolerances if t.group in ("", point.group)]
            limit = point.tolerance_mm if point.tolerance_mm is not None else min(named, default=None)
            if limit is not None:
                limits[point.name] = limit * MILLIMETRE
        return cls(limits, file.goal.level_pct / 100.0, file.goal.robust)

    def __bool__(self) -> bool:
        return bool(self.tolerance)


def importance(file: PlanFile) -> dict[str, float]:
    """Weights of a plan's points, divided by the squares of their tolerances."""
    demands = Tolerances.of(file)
    if not demands:
        return {p.name: max(p.weight, MIN_WEIGHT) for p in file.listed if p.weight != 1.0}
    tight, wide = min(demands.tolerance.values()), DEFAULT_TOLERANCE_FACTOR * max(demands.tolerance.values())
    return {p.name: max(p.weight * (tight / demands.tolerance.get(p.name, wide)) ** 2, MIN_WEIGHT) for p in file.listed}


def radius(covariance: Floats, level: float) -> Floats:
    """Radius (T,) that errors of points with covariances (T, 3, 3) do not exceed with probability `level`.

    The squared length of a normal error is a weighted sum of chi-squares; its quantile is that of the scaled chi-square
    with the same mean and variance (Satterthwaite, Biometrics Bulletin 2 (1946) 110-114), which is exact for errors
    along one axis and for isotropic errors in a plane or in space.
    """
    mean = np.einsum("tii->t", covariance)
    square = np.einsum("tij,tji->t", covariance, covariance)
    freedom = np.where(square > 0, mean**2 / np.where(square > 0, square, 1.0), 1.0)
    return np.sqrt(mean / freedom * 2.0 * gammaincinv(0.5 * freedom, level))


@dataclass(frozen=True)
class ToleranceCheck:
    """Check of a layout against its tolerances, complete or after a loss."""

    lost: str
    """Text of the lost station or sight; empty for the complete layout."""
    tolerance: Mapping[str, float]
    """Tolerance of each point [m], by name."""
    radius: Mapping[str, float]
    """Error [m] at the confidence level of each determined point with a tolerance."""
    ratio: float
    """Largest ratio of radius to tolerance; infinite if a point is undetermined."""
    worst: str
    """Point with the largest ratio."""
    unseen: tuple[str, ...] = ()
    """Points with a tolerance that no station sees."""

    @property
    def good(self) -> bool:
        """True if all tolerances are met."""
        return is_met(self.ratio)

    @property
    def of_sight(self) -> bool:
        """True if the loss is a sight and not a station."""
        return self.lost.startswith(SIGHT)

    @property
    def over(self) -> list[str]:
        """Determined points whose errors exceed their tolerances."""
        return [name for name in self.radius if not is_met(self.used(name))]

    def used(self, name: str) -> float:
        """Ratio of a point's error to its tolerance."""
        return self.radius[name] / self.tolerance[name]

    @property
    def worst_words(self) -> str:
        """Text of the worst point with its numbers."""
        return self.numbers(self.worst) if self.worst in self.radius else self.worst

    @property
    def worst_point(self) -> str:
        """Text of the worst point with its margin or excess; empty for none."""
        excess = 100 * (self.ratio - 1)
        margin = f"margin {-excess:.0f} %" if self.good else f"{excess:{'.0f' if excess >= 1 else '.1g'}} % too large"
        margin = margin if np.isfinite(excess) else "not visible from any station"
        return f"worst point {self.worst_words} ({margin})" if self.radius else UNDETERMINED

    @property
    def remaining(self) -> str:
        """Clause on the points that are not visible or exceed their tolerances."""
        if self.good:
            return f"all tolerances are met, worst point {self.worst_words}"
        verb, named = "is" if len(self.unseen) == 1 else "are", listing(self.unseen, MAX_NAMED)
        parts = [f"{named} {verb} not visible from any station"] if self.unseen else []
        if not self.radius:
            parts.append(UNDETERMINED)
        if self.over:
            worst, many = max(self.over, key=self.used), len(self.over) > 1
            points = f"{len(self.over)} points exceed their tolerances" if many else "1 point exceeds its tolerance"
            parts.append(f"{points} ({'worst ' if many else ''}{self.numbers(worst)})")
        return ", ".join(parts)

    def numbers(self, name: str) -> str:
        """Text of a point with its error and its tolerance."""
        error, tolerance = self.radius[name] / MILLIMETRE, self.tolerance[name] / MILLIMETRE
        return f"{name}: {text_near_limit(error, tolerance)} mm, limit {tolerance:.6g} mm"


def judged(survey: Survey, demands: Tolerances, built: Construction, lost: str = "") -> ToleranceCheck:
    """Check of a survey; points that no station sees are removed from the network and reported."""
    visible: Bools = np.asarray(survey.visible.any(axis=0))
    unseen = tuple(n for n, s in zip(survey.target_names, visible, strict=True) if not s and n in demands.tolerance)
    try:
        if not visible.any():
            raise NetworkError("no station sees a target")
        information = LayoutInformation.of(survey.only(visible), built)
    except NetworkError:
        return ToleranceCheck(lost, demands.tolerance, {}, np.inf, "", unseen)
    names = information.survey.target_names
    every = dict(zip(names, radius(information.target_covariance, demands.level).tolist(), strict=True))
    radii = {name: every[name] for name in demands.tolerance if name in every}
    ratios = {name: value / demands.tolerance[name] for name, value in radii.items()}
    worst = unseen[0] if unseen else max(ratios, key=lambda name: ratios[name], default="")
    return ToleranceCheck(
        lost, demands.tolerance, radii, np.inf if unseen or not ratios else ratios[worst], worst, unseen
    )


def after_losses(survey: Survey, demands: Tolerances, built: Construction, kind: str) -> Iterator[ToleranceCheck]:
    """Checks of a survey without each station (`station`), or without each sight of a point (`sight`)."""
    if kind == "station":
        for s, name in enumerate(survey.station_names):
            yield judged(survey.without(s), demands, built, name)
        return
    for s, t in np.argwhere(survey.visible).tolist():
        # A sight of a point without a tolerance is one of many that hold the network.
        if survey.target_names[t] in demands.tolerance:
            visible = survey.visible.copy()
            visible[s, t] = False
            name = f"{SIGHT} from {survey.station_names[s]} to {survey.target_names[t]}"
            yield judged(survey.replace(visible=visible), demands, built, name)


def every_loss(survey: Survey, demands: Tolerances, built: Construction) -> tuple[ToleranceCheck, ...]:
    """Checks of a survey without each station, then without each sight of a point with a tolerance."""
    kinds = ("station", "sight") if demands else ()
    return tuple(check for kind in kinds for check in after_losses(survey, demands, built, kind))


def losses_of(survey: Survey, demands: Tolerances, built: Construction) -> list[ToleranceCheck]:
    """Checks without each station, and without each sight if tolerances must withstand that, for a verdict."""
    kinds = ("station", "sight") if demands.robust == "sight" else ("station",)
    return [loss for kind in kinds for loss in after_losses(survey, demands, built, kind)]


def is_feasible(survey: Survey, demands: Tolerances, built: Construction) -> tuple[bool, float]:
    """Flag that a survey meets its tolerances (after any single loss if required), and the largest ratio."""
    whole = judged(survey, demands, built)
    if not whole.good or demands.robust == "no":
        return whole.good, whole.ratio
    worst = max(loss.ratio for loss in after_losses(survey, demands, built, demands.robust))
    return is_met(worst), worst


@dataclass(frozen=True)
class PlanVerdict:
    """Verdict on a layout by the rules and tolerances of its plan, common to search, moves, planner and page."""

    reached: bool
    """True if no rule is broken and all tolerances are met, after any single loss if required."""
    words: str
    """Sentences of the verdict, without the last full stop."""


def verdict(
    demands: Tolerances, check: ToleranceCheck, losses: Sequence[ToleranceCheck], broken: Sequence[BrokenRule] = ()
) -> PlanVerdict:
    """Verdict from broken rules, the worst point with its margin, and the worst check after the loss of a station."""
    asked = [loss for loss in losses if demands.robust == ("sight" if loss.of_sight else "station")]
    reached = not broken and check.good and all(loss.good for loss in asked)
    count = len(demands.tolerance)
    number = f"all {count}" if check.good else f"{len(check.radius) - len(check.over)} of {count}"
    words = f"{number} tolerances are met at {100 * demands.level:g} % confidence; {check.worst_point}"
    worst = max((loss for loss in losses if not loss.of_sight), key=lambda loss: loss.ratio, default=None)
    if worst is not None:
        lost = "without any one station all are met" if worst.good else f"without {worst.lost} they are not met"
        words += f". {lost[0].upper()}{lost[1:]}; {worst.worst_point}"
    rules = f"the layout breaks a rule ({words_of(broken)}). " if broken else ""
    words = words[0].upper() + words[1:] if broken else words
    return PlanVerdict(reached, f"{'Reached' if reached else 'Not reached'}: {rules}{words}")


def loss_sentences(losses: Sequence[ToleranceCheck]) -> list[str]:
    """Sentences on the tolerances after the loss of a station or a sight."""
    texts = [f"Without {loss.lost}: {loss.remaining}." for loss in losses if not loss.of_sight]
    sights = [loss for loss in losses if loss.of_sight]
    broken = sorted((loss for loss in sights if not loss.good), key=lambda loss: -loss.ratio)
    if broken:
        number = f"{len(broken)} of {len(sights)} sights"
        texts.append(f"{number} are critical; without {broken[0].lost}: {broken[0].remaining}.")
    elif sights:
        texts.append(
            f"Any single one of the {len(sights)} sights of these points may be blocked; all tolerances are still met."
        )
    return texts
