"""Tolerances of points: how far each may be off, whether a layout keeps that, what remains after a loss."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from ltsim.arrays import Bools, Floats
from ltsim.errors import NetworkError
from ltsim.model.construction import Construction
from ltsim.planning.information import LayoutInformation
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.units import MILLIMETRE

LOOSE = 10.0
"""Points without a tolerance count as if theirs were so many times the widest one."""
LEAST_WEIGHT = 1e-6
SIGHT = "the sight"
"""How the name of a lost sight begins."""


@dataclass(frozen=True)
class Demands:
    """What is asked of points."""

    tolerance: Mapping[str, float]
    """[m]: by point."""
    level: float = 0.95
    """Share of cases in which a point must be within."""
    robust: str = "no"
    """`no`, or which loss must not break a tolerance: `sight`, `station`."""

    @classmethod
    def of(cls, file: PlanFile) -> Demands:
        """Those of a plan file: a point's own tolerance, else the tightest that names its group or all."""
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
    """How a layout stands to the demands."""

    lost: str
    """What is lost; empty for the whole layout."""
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
        return self.ratio <= 1.0


def judged(survey: Survey, demands: Demands, built: Construction, lost: str = "") -> Kept:
    """How a survey stands to the demands; points that nobody sees are left out of the network and named."""
    seen: Bools = np.asarray(survey.seen.any(axis=0))
    unseen = tuple(n for n, s in zip(survey.target_names, seen, strict=True) if not s and n in demands.tolerance)
    try:
        information = LayoutInformation.of(only(survey, seen), built)
    except NetworkError:
        return Kept(lost, {}, np.inf, "", unseen)
    names = information.survey.target_names
    every = dict(zip(names, radius(information.target_covariance, demands.level).tolist(), strict=True))
    found = {name: every[name] for name in demands.tolerance if name in every}
    ratios = {name: value / demands.tolerance[name] for name, value in found.items()}
    worst = max(ratios, key=lambda name: ratios[name], default="")
    return Kept(lost, found, np.inf if unseen or not ratios else ratios[worst], unseen[0] if unseen else worst, unseen)


def only(survey: Survey, targets: Bools) -> Survey:
    """The survey with some of its targets only."""
    if targets.all():
        return survey
    rank = None if survey.rank is None else np.argsort(np.argsort(survey.rank[:, targets], axis=1), axis=1)
    return survey.replace(
        target_names=tuple(n for n, k in zip(survey.target_names, targets, strict=True) if k),
        points=survey.points[targets],
        seen=survey.seen[:, targets],
        rank=rank,
    )


def after_losses(survey: Survey, demands: Demands, built: Construction, kind: str) -> Iterator[Kept]:
    """How the survey stands without each station in turn (`station`), or each sight of a point (`sight`)."""
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
    """How the survey stands without each station, then without each sight of a point with a tolerance."""
    kinds = ("station", "sight") if demands else ()
    return tuple(kept for kind in kinds for kept in after_losses(survey, demands, built, kind))


def holds(survey: Survey, demands: Demands, built: Construction) -> tuple[bool, float]:
    """Whether a survey keeps its demands, after any one loss too where they ask so; and the largest ratio."""
    own = judged(survey, demands, built)
    if not own.good or demands.robust == "no":
        return own.good, own.ratio
    worst = max(kept.ratio for kept in after_losses(survey, demands, built, demands.robust))
    return worst <= 1.0, worst


def reached(demands: Demands, kept: Kept, losses: Sequence[Kept]) -> bool:
    """The goal is reached: all tolerances are kept, after any one loss too where that is asked for."""
    return kept.good and all(loss.good for loss in _asked(demands, losses))


def _asked(demands: Demands, losses: Sequence[Kept]) -> list[Kept]:
    """Losses that must not break a tolerance."""
    wanted = {"no": (), "sight": (True,), "station": (False,)}[demands.robust]
    return [loss for loss in losses if loss.lost.startswith(SIGHT) in wanted]


def verdict(demands: Demands, kept: Kept, losses: Sequence[Kept]) -> str:
    """Reached or not, the worst point and its margin, and the worst of it with any one station lost."""
    count, share = len(demands.tolerance), f"{100 * demands.level:g} %"
    over = sum(value > demands.tolerance[name] for name, value in kept.radius.items()) + len(kept.unseen)
    what = f"all {count} tolerances" if kept.good else f"{count - over} of {count} tolerances"
    words = f"{what} kept at {share}, worst {_worst(demands, kept)} ({_margin(kept)})"
    worst = max((loss for loss in losses if not loss.lost.startswith(SIGHT)), key=lambda loss: loss.ratio, default=None)
    if worst is not None:
        lost = "all kept too" if worst.good else f"not kept without {worst.lost}"
        left = f"worst {_worst(demands, worst)} ({_margin(worst)})" if worst.radius else "nothing is determined"
        words += f"; with any one station lost {lost}, {left}"
    return f"{'Reached' if reached(demands, kept, losses) else 'Not reached'}: {words}"


def _margin(kept: Kept) -> str:
    """How much of a tolerance is left, or how far it is missed."""
    if not np.isfinite(kept.ratio):
        return "seen from nowhere"
    left = 100 * (1 - kept.ratio)
    return f"margin {left:.0f} %" if left >= 0 else f"{-left:.0f} % too large"


def sentences(demands: Demands, losses: Sequence[Kept]) -> list[str]:
    """What remains when a station or a sight is lost."""
    stations = [loss for loss in losses if not loss.lost.startswith(SIGHT)]
    found = [f"Without {loss.lost} {_remains(demands, loss)}." for loss in stations]
    sights = [loss for loss in losses if loss.lost.startswith(SIGHT)]
    broken = sorted((loss for loss in sights if not loss.good), key=lambda loss: -loss.ratio)
    if sights and not broken:
        found.append(f"Any one of {len(sights)} sights of these points may be blocked: the tolerances hold.")
    elif broken:
        more = f", and {len(broken) - 1} more of {len(sights)}" if len(broken) > 1 else f", alone of {len(sights)}"
        found.append(f"Blocking {broken[0].lost} breaks a tolerance ({_remains(demands, broken[0])}){more}.")
    return found


def _remains(demands: Demands, kept: Kept) -> str:
    if kept.good:
        return f"all tolerances hold; {_worst(demands, kept)} comes nearest"
    verb = "is" if len(kept.unseen) == 1 else "are"
    unseen = f"{_listed(kept.unseen)} {verb} seen from nowhere" if kept.unseen else ""
    over = [name for name, value in kept.radius.items() if value > demands.tolerance[name]]
    if not over:
        return unseen or "nothing is determined"
    worst = max(over, key=lambda name: kept.radius[name] / demands.tolerance[name])
    words = f"{_point(demands, kept, worst)} is too large" + (f", {len(over) - 1} more too" if len(over) > 1 else "")
    return f"{unseen}, {words}" if unseen else words


def _worst(demands: Demands, kept: Kept) -> str:
    return _point(demands, kept, kept.worst) if kept.worst in kept.radius else kept.worst or "every point"


def _point(demands: Demands, kept: Kept, name: str) -> str:
    return f"{name} with {kept.radius[name] / MILLIMETRE:.3g} of {demands.tolerance[name] / MILLIMETRE:.3g} mm"


def _listed(names: Sequence[str], most: int = 5) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
