"""Tolerances of points, check of a layout against them, and checks after the loss of a station or a sight.

A sight is the line from a station to a point that the station measures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.core.notation import names_text
from ltsim.core.units import MILLIMETRE
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.layout_rules import BrokenRule, broken_rules_text
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import PlannedSurvey

DEFAULT_TO_WIDEST_TOLERANCE_RATIO = 10.0
"""Ratio that defines the weight of a point without a tolerance in the objective: the point counts as if its tolerance
were this many times the widest tolerance of the plan."""
MIN_POINT_WEIGHT = 1e-6
"""Smallest weight of a point in the objective, above zero, so that every point counts."""
MAX_POINTS_IN_VERDICT = 5
"""Largest number of points that a sentence of the verdict lists."""
LOST_SIGHT_PREFIX = "the sight"
"""First words of the description of a lost sight ("the sight from S1 to P3"); a lost station is described by its name.
"""
UNDETERMINED_NETWORK_TEXT = "the network no longer determines its points"
"""Text in place of point errors for a network whose poses or points are not all determined."""


def is_tolerance_met(ratio: float) -> bool:
    """True if an error is at most its tolerance; `ratio` is the unrounded error divided by the unrounded tolerance."""
    return ratio <= 1.0


def text_distinct_from_limit(value: float, limit: float) -> str:
    """Text of `value` with at least three digits, and with enough to show on which side of `limit` the value is."""
    texts = (f"{value:.{count}g}" for count in range(3, 17))
    return next((text for text in texts if (float(text) > limit) == (value > limit)), repr(value))


def tolerance_ratio_text(ratio: float) -> str:
    """Text in percent of the ratio of an error to its tolerance (`100.4 %` for an error that is 0.4 % too large).

    The text has enough digits to show on which side of 100 % the ratio is.
    """
    return f"{text_distinct_from_limit(100.0 * ratio, 100.0)} %"


@dataclass(frozen=True)
class PointTolerances:
    """Tolerances of points, their confidence level, and the kind of loss after which they must still be met."""

    tolerance_by_point_m: Mapping[str, float]
    """Tolerance of each point [m], by name."""
    confidence_level: float = 0.95
    """Confidence level: fraction of cases in which a point must be within its tolerance."""
    loss_to_withstand: str = "no"
    """Loss after which all tolerances must still be met: "sight" for any single sight, "station" for any single
    station, or "no"."""

    @classmethod
    def from_plan_file(cls, file: PlanFile) -> PointTolerances:
        """Tolerances of the points in a plan file.

        The tolerance of a point is its `tolerance_mm` if given, otherwise the smaller of two tolerances, that of its
        group and that of all points.
        """
        limits = {}
        for point in file.listed_points:
            named = [t.tolerance_mm for t in file.goal.tolerances if t.group in ("", point.group)]
            limit = point.tolerance_mm if point.tolerance_mm is not None else min(named, default=None)
            if limit is not None:
                limits[point.name] = limit * MILLIMETRE
        return cls(limits, file.goal.confidence_level_pct / 100.0, file.goal.loss_to_withstand)

    def __bool__(self) -> bool:
        return bool(self.tolerance_by_point_m)


def point_weights(file: PlanFile) -> dict[str, float]:
    """Weight of the squared error of each point in the objective, by name.

    The result is the `weight` of the point times the squared ratio of the smallest tolerance to that of the point.
    Without tolerances the result is the `weight`, and only points whose weight is not 1 are returned.
    """
    demands = PointTolerances.from_plan_file(file)
    if not demands:
        return {p.name: max(p.weight, MIN_POINT_WEIGHT) for p in file.listed_points if p.weight != 1.0}
    tight, wide = (
        min(demands.tolerance_by_point_m.values()),
        DEFAULT_TO_WIDEST_TOLERANCE_RATIO * max(demands.tolerance_by_point_m.values()),
    )
    return {
        p.name: max(p.weight * (tight / demands.tolerance_by_point_m.get(p.name, wide)) ** 2, MIN_POINT_WEIGHT)
        for p in file.listed_points
    }


def error_radius(covariance: Floats, confidence_level: float) -> Floats:
    """Radius (T,) [m] that the error of each of T points does not exceed with probability `confidence_level`.

    `covariance` (T, 3, 3) [m^2] are the covariances of the points. The squared length of a normal error is a weighted
    sum of chi-squares. Its quantile is approximated by that of a scaled chi-square with equal mean and variance
    (Satterthwaite, Biometrics Bulletin 2 (1946) 110-114). The approximation is exact for errors along one axis and for
    isotropic errors in a plane or in space.
    """
    variance_sums = np.einsum("tii->t", covariance)
    square = np.einsum("tij,tji->t", covariance, covariance)
    freedom = np.where(square > 0, variance_sums**2 / np.where(square > 0, square, 1.0), 1.0)
    return np.sqrt(variance_sums / freedom * 2.0 * gammaincinv(0.5 * freedom, confidence_level))


@dataclass(frozen=True)
class ToleranceCheck:
    """Check of the point errors of a layout against their tolerances.

    The layout is complete, or lacks a station or a sight (the line from a station to a point that it measures).
    """

    lost_station_or_sight: str
    """Description of the lost station or sight; empty for the complete layout."""
    tolerance_by_point_m: Mapping[str, float]
    """Tolerance of each point [m], by name."""
    error_by_point_m: Mapping[str, float]
    """Point error [m] that is not exceeded at the confidence level, for each determined point with a tolerance, by
    name."""
    max_tolerance_ratio: float
    """Largest ratio of point error to tolerance; infinite if a point is undetermined."""
    worst_point_name: str
    """Name of the point with the largest ratio of point error to tolerance."""
    unseen_points: tuple[str, ...] = ()
    """Names of points with a tolerance that no station sees."""

    @property
    def meets_all_tolerances(self) -> bool:
        """True if the error of every point is at most its tolerance."""
        return is_tolerance_met(self.max_tolerance_ratio)

    @property
    def is_sight_loss(self) -> bool:
        """True if the layout lacks a sight; False if it lacks a station or is complete."""
        return self.lost_station_or_sight.startswith(LOST_SIGHT_PREFIX)

    @property
    def exceeding_points(self) -> list[str]:
        """Names of the determined points whose errors are larger than their tolerances."""
        return [name for name in self.error_by_point_m if not is_tolerance_met(self.tolerance_ratio(name))]

    def tolerance_ratio(self, name: str) -> float:
        """Ratio of the error of the point `name` to its tolerance."""
        return self.error_by_point_m[name] / self.tolerance_by_point_m[name]

    @property
    def worst_point_values_text(self) -> str:
        """Text of the worst point with its error and its tolerance; only its name if no station sees it."""
        return (
            self.point_error_text(self.worst_point_name)
            if self.worst_point_name in self.error_by_point_m
            else self.worst_point_name
        )

    @property
    def worst_point_margin_text(self) -> str:
        """Text of the worst point with its error, and by what percentage the error is below or above the tolerance."""
        excess = 100 * (self.max_tolerance_ratio - 1)
        margin = (
            f"margin {-excess:.0f} %"
            if self.meets_all_tolerances
            else f"{excess:{'.0f' if excess >= 1 else '.1g'}} % too large"
        )
        margin = margin if np.isfinite(excess) else "not visible from any station"
        return (
            f"worst point {self.worst_point_values_text} ({margin})"
            if self.error_by_point_m
            else UNDETERMINED_NETWORK_TEXT
        )

    @property
    def violations_clause(self) -> str:
        """Clause on points that no station sees or whose errors are too large, or that all tolerances are met."""
        if self.meets_all_tolerances:
            return f"all tolerances are met, worst point {self.worst_point_values_text}"
        verb, named = (
            "is" if len(self.unseen_points) == 1 else "are",
            names_text(self.unseen_points, MAX_POINTS_IN_VERDICT),
        )
        clauses = [f"{named} {verb} not visible from any station"] if self.unseen_points else []
        if not self.error_by_point_m:
            clauses.append(UNDETERMINED_NETWORK_TEXT)
        if self.exceeding_points:
            worst, many = max(self.exceeding_points, key=self.tolerance_ratio), len(self.exceeding_points) > 1
            points = (
                f"{len(self.exceeding_points)} points exceed their tolerances"
                if many
                else "1 point exceeds its tolerance"
            )
            clauses.append(f"{points} ({'worst ' if many else ''}{self.point_error_text(worst)})")
        return ", ".join(clauses)

    def point_error_text(self, name: str) -> str:
        """Text of the point `name` with its error and its tolerance."""
        error, tolerance = self.error_by_point_m[name] / MILLIMETRE, self.tolerance_by_point_m[name] / MILLIMETRE
        return f"{name}: {text_distinct_from_limit(error, tolerance)} mm, limit {tolerance:.6g} mm"


def check_tolerances(
    survey: PlannedSurvey,
    tolerances: PointTolerances,
    construction: GeometricErrorModel,
    lost_station_or_sight: str = "",
) -> ToleranceCheck:
    """Check of the point errors in the layout of `survey` against `tolerances`, from the expected network adjustment.

    `construction` is the geometric error model whose parameters the adjustment estimates. Points that no station sees
    are removed from the network and reported. `lost_station_or_sight` describes the station or sight that is missing in
    the survey.
    """
    visible: Bools = np.asarray(survey.is_visible.any(axis=0))
    unseen = tuple(
        n for n, s in zip(survey.target_names, visible, strict=True) if not s and n in tolerances.tolerance_by_point_m
    )
    try:
        if not visible.any():
            raise NetworkError("no station sees any target")
        information = ExpectedPrecision.from_survey(survey.with_targets_only(visible), construction)
    except NetworkError:
        return ToleranceCheck(lost_station_or_sight, tolerances.tolerance_by_point_m, {}, np.inf, "", unseen)
    names = information.survey.target_names
    radius_by_name = dict(
        zip(names, error_radius(information.target_covariances, tolerances.confidence_level).tolist(), strict=True)
    )
    radii = {name: radius_by_name[name] for name in tolerances.tolerance_by_point_m if name in radius_by_name}
    ratios = {name: value / tolerances.tolerance_by_point_m[name] for name, value in radii.items()}
    worst_point = unseen[0] if unseen else max(ratios, key=lambda name: ratios[name], default="")
    return ToleranceCheck(
        lost_station_or_sight,
        tolerances.tolerance_by_point_m,
        radii,
        np.inf if unseen or not ratios else ratios[worst_point],
        worst_point,
        unseen,
    )


def checks_after_losses_of_kind(
    survey: PlannedSurvey, tolerances: PointTolerances, construction: GeometricErrorModel, loss_kind: str
) -> Iterator[ToleranceCheck]:
    """Checks of the tolerances for the layout of `survey` after each single loss of one kind.

    `loss_kind` is ``station``, or ``sight`` for the sights of points with a tolerance.
    """
    if loss_kind == "station":
        for s, name in enumerate(survey.station_names):
            yield check_tolerances(survey.without_station(s), tolerances, construction, name)
        return
    for s, t in np.argwhere(survey.is_visible).tolist():
        # A sight of a point without a tolerance is one of many that hold the network.
        if survey.target_names[t] in tolerances.tolerance_by_point_m:
            visible = survey.is_visible.copy()
            visible[s, t] = False
            name = f"{LOST_SIGHT_PREFIX} from {survey.station_names[s]} to {survey.target_names[t]}"
            yield check_tolerances(survey.replace(is_visible=visible), tolerances, construction, name)


def checks_after_every_loss(
    survey: PlannedSurvey, tolerances: PointTolerances, construction: GeometricErrorModel
) -> tuple[ToleranceCheck, ...]:
    """Checks of the tolerances without each station, then without each sight of a point with a tolerance.

    The result is empty if there are no tolerances.
    """
    kinds = ("station", "sight") if tolerances else ()
    return tuple(
        check for kind in kinds for check in checks_after_losses_of_kind(survey, tolerances, construction, kind)
    )


def checks_after_required_losses(
    survey: PlannedSurvey, tolerances: PointTolerances, construction: GeometricErrorModel
) -> list[ToleranceCheck]:
    """Checks of the tolerances without each station, and, if the plan requires it, without each sight.

    The loss of a sight (line from a station to a measured point) is required if `tolerances.loss_to_withstand` is
    "sight".
    """
    kinds = ("station", "sight") if tolerances.loss_to_withstand == "sight" else ("station",)
    return [loss for kind in kinds for loss in checks_after_losses_of_kind(survey, tolerances, construction, kind)]


def feasibility_and_tolerance_ratio(
    survey: PlannedSurvey, tolerances: PointTolerances, construction: GeometricErrorModel
) -> tuple[bool, float]:
    """Flag that is True if a survey meets its tolerances, and largest ratio of point error to tolerance.

    If tolerances must still be met after a loss, flag and ratio refer to the worst loss. If the complete survey does
    not meet the tolerances, flag and ratio refer to the complete survey.
    """
    verdict = check_tolerances(survey, tolerances, construction)
    if not verdict.meets_all_tolerances or tolerances.loss_to_withstand == "no":
        return verdict.meets_all_tolerances, verdict.max_tolerance_ratio
    largest_ratio = max(
        loss.max_tolerance_ratio
        for loss in checks_after_losses_of_kind(survey, tolerances, construction, tolerances.loss_to_withstand)
    )
    return is_tolerance_met(largest_ratio), largest_ratio


@dataclass(frozen=True)
class PlanVerdict:
    """Verdict whether a layout meets the rules and tolerances of its plan, for search, interactive planner and page."""

    is_goal_reached: bool
    """True if no rule is broken and all tolerances are met, also after any single loss if the plan requires it."""
    sentences: str
    """Sentences of the verdict, without the last full stop."""


def plan_verdict(
    tolerances: PointTolerances,
    tolerance_check: ToleranceCheck,
    loss_checks: Sequence[ToleranceCheck],
    broken_rules: Sequence[BrokenRule] = (),
) -> PlanVerdict:
    """Verdict on a layout from its broken rules, and from checks of its tolerances, complete and after each loss.

    A loss is that of a station, or of a sight from a station to a point.
    """
    asked = [
        loss for loss in loss_checks if tolerances.loss_to_withstand == ("sight" if loss.is_sight_loss else "station")
    ]
    reached = (
        not broken_rules and tolerance_check.meets_all_tolerances and all(loss.meets_all_tolerances for loss in asked)
    )
    n_points = len(tolerances.tolerance_by_point_m)
    count_text = (
        f"all {n_points}"
        if tolerance_check.meets_all_tolerances
        else f"{len(tolerance_check.error_by_point_m) - len(tolerance_check.exceeding_points)} of {n_points}"
    )
    words = (
        f"{count_text} tolerances are met at {100 * tolerances.confidence_level:g} % confidence; "
        f"{tolerance_check.worst_point_margin_text}"
    )
    worst_loss = max(
        (loss for loss in loss_checks if not loss.is_sight_loss),
        key=lambda loss: loss.max_tolerance_ratio,
        default=None,
    )
    if worst_loss is not None:
        lost = (
            "after the loss of any one station all are met"
            if worst_loss.meets_all_tolerances
            else f"without {worst_loss.lost_station_or_sight} they are not met"
        )
        words += f". {lost[0].upper()}{lost[1:]}; {worst_loss.worst_point_margin_text}"
    rules = f"the layout breaks a rule ({broken_rules_text(broken_rules)}). " if broken_rules else ""
    words = words[0].upper() + words[1:] if broken_rules else words
    return PlanVerdict(reached, f"{'Reached' if reached else 'Not reached'}: {rules}{words}")


def loss_sentences(loss_checks: Sequence[ToleranceCheck]) -> list[str]:
    """Sentences on the tolerances after losses: one for each lost station, one for the loss of any single sight."""
    texts = [
        f"Without {loss.lost_station_or_sight}: {loss.violations_clause}."
        for loss in loss_checks
        if not loss.is_sight_loss
    ]
    sights = [loss for loss in loss_checks if loss.is_sight_loss]
    broken = sorted(
        (loss for loss in sights if not loss.meets_all_tolerances), key=lambda loss: -loss.max_tolerance_ratio
    )
    if broken:
        number = f"{len(broken)} of {len(sights)} sights"
        texts.append(
            f"{number} are critical; without {broken[0].lost_station_or_sight}: {broken[0].violations_clause}."
        )
    elif sights:
        texts.append(
            f"Any single one of the {len(sights)} sights of these points may be blocked; all tolerances are still met."
        )
    return texts
