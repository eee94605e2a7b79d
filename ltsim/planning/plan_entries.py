"""Entries of plan.json (stations, reflectors, parameters, layouts), each created from a part of the planned network."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pydantic import Field

from ltsim.calibration.combinations import UndeterminedEntry
from ltsim.core.units import MICROMETRE, MILLIMETRE, SI_PER_UNIT
from ltsim.planning.objective import TARGETS_QUALITY_NAME
from ltsim.planning.reflector_changes import to_degrees, to_millimetres
from ltsim.planning.tolerances import ToleranceCheck, is_tolerance_met, tolerance_ratio_text
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, Positive, Vector

if TYPE_CHECKING:
    from ltsim.adjustment.remedies.detectability import MinimalDetectableSize
    from ltsim.planning.expected_precision import ExpectedDisagreement, ExpectedPrecision
    from ltsim.planning.planner import LayoutEvaluation, TradeoffPoint
    from ltsim.planning.survey import PlannedSurvey

QualityValues = dict[str, OptionalFloat]
"""Value of each quality of a layout by name (`instrument`, `targets`, `diagnosis`, see `LayoutObjective`); null if
undetermined."""
SizesAlongXyzUm = tuple[OptionalFloat, OptionalFloat, OptionalFloat] | tuple[()]
"""Sizes along x, y and z [um], or an empty tuple if they are unknown."""


class PlannedStationEntry(Entry):
    """Station of a plan with its pose and expected precision."""

    name: str
    """Name of the station."""
    position_mm: Vector
    """Position of the centre of the tracker head [mm], in the hall frame."""
    yaw_deg: Finite
    """Direction of azimuth zero [deg], counter-clockwise (seen from above) from the x axis of the hall."""
    sigma_position_um: SizesAlongXyzUm = ()
    """Expected standard deviations of the position along x, y and z [um]."""
    visible_reflectors: int = 0
    """Number of reflectors that the station sees."""

    @classmethod
    def from_survey(cls, survey: PlannedSurvey) -> tuple[Self, ...]:
        """Entries of the stations of a planned survey, with poses but without standard deviations."""
        station_fields = zip(survey.station_names, survey.station_positions, survey.station_yaws, strict=True)
        return tuple(
            cls(name=name, position_mm=to_millimetres(place), yaw_deg=to_degrees(yaw))
            for name, place, yaw in station_fields
        )

    @classmethod
    def from_layout(cls, layout: LayoutEvaluation) -> tuple[Self, ...]:
        """Entries of the stations of a layout, with their expected precision."""
        sigma = np.sqrt(np.einsum("sii->si", layout.expected_precision.pose_covariance[:, :3, :3])) / MICROMETRE
        counts = layout.survey.is_visible.sum(axis=1).tolist()
        return tuple(
            cls(
                name=place.name,
                position_mm=place.position_mm,
                yaw_deg=place.yaw_deg,
                sigma_position_um=tuple(np.round(station_sigma, 2).tolist()),
                visible_reflectors=count,
            )
            for place, station_sigma, count in zip(cls.from_survey(layout.survey), sigma, counts, strict=True)
        )


class PlannedReflectorEntry(Entry):
    """Reflector of a plan with its position and expected precision."""

    name: str
    """Name of the reflector."""
    position_mm: Vector
    """Position of the centre of the reflector [mm], in the hall frame."""
    sigma_um: OptionalFloat
    """Expected point error of the reflector [um]: square root of the trace of its covariance."""
    expanded_uncertainty_um: SizesAlongXyzUm = Field(default=(), alias="U_um")
    """Expanded uncertainty (k = 2) of the coordinates x, y and z [um], with the mean of all points as datum."""
    stations_seeing: int = 0
    """Number of stations that see the reflector."""
    visible_from: tuple[str, ...] = ()
    """Names of the stations that see the reflector."""
    point_error_mm: OptionalFloat = None
    """Point error [mm] that is not exceeded at the confidence level of the goal; null without a tolerance."""
    tolerance_mm: OptionalFloat = None
    """Largest permitted point error [mm]; null without a tolerance."""
    tolerance_ratio: OptionalFloat = None
    """Ratio of point error to tolerance (`point_error_mm` / `tolerance_mm`); at most 1 if the tolerance is met."""
    tolerance_met: bool | None = None
    """True if the expected uncertainty is within its tolerance; null without a tolerance."""

    @classmethod
    def from_layout(cls, layout: LayoutEvaluation, check: ToleranceCheck | None) -> tuple[Self, ...]:
        """Entries of the reflectors of a layout with their expected precision.

        If there is a `check` against tolerances, the entries contain its results.
        """
        survey, information = layout.survey, layout.expected_precision
        expanded = 2.0 * np.sqrt(np.einsum("tii->ti", information.target_covariances)) / MICROMETRE
        return tuple(
            cls(
                name=name,
                position_mm=to_millimetres(survey.target_points[t], 3),
                sigma_um=round(float(information.target_point_errors[t]) / MICROMETRE, 2),
                U_um=tuple(np.round(expanded[t], 2).tolist()),
                stations_seeing=int(survey.is_visible[:, t].sum()),
                visible_from=tuple(survey.station_names[s] for s in np.flatnonzero(survey.is_visible[:, t])),
                **cls._point_error_fields(name, check),
            )
            for t, name in enumerate(survey.target_names)
        )

    @staticmethod
    def _point_error_fields(name: str, check: ToleranceCheck | None) -> dict[str, Any]:
        """Values of the fields on the tolerance of the reflector `name`, by field name; empty without a tolerance."""
        if check is None or name not in check.error_by_point_m:
            return {}
        within, used = check.error_by_point_m[name] / MILLIMETRE, check.tolerance_ratio(name)
        return {
            "point_error_mm": within, "tolerance_mm": check.tolerance_by_point_m[name] / MILLIMETRE,
            "tolerance_ratio": used, "tolerance_met": is_tolerance_met(used),
        }  # fmt: skip


class PlannedParameterEntry(Entry):
    """Instrument parameter of a plan with its expected standard deviation."""

    name: str
    """Name of the parameter."""
    unit: str = ""
    """Unit of `sigma` and `prior_sigma`."""
    sigma: Finite
    """Expected standard deviation of the parameter after calibration."""
    prior_sigma: Positive
    """Standard deviation of the parameter before any reading (prior)."""
    removed_variance_fraction: OptionalFloat = None
    """Fraction of the prior variance that the readings are expected to remove: 1 - (sigma / prior_sigma)^2."""

    @classmethod
    def from_expected_precision(cls, expected_precision: ExpectedPrecision) -> tuple[Self, ...]:
        """Entries of the instrument parameters of a layout, with standard deviations in the units of display."""
        parameter_fields = zip(
            expected_precision.construction.parameters,
            expected_precision.instrument_sigmas,
            expected_precision.prior_sigma,
            strict=True,
        )
        return tuple(
            cls(
                name=p.name,
                unit=p.unit,
                sigma=float(sigma / p.si_per_display_unit),
                prior_sigma=float(prior / p.si_per_display_unit),
                removed_variance_fraction=float(1.0 - (sigma / prior) ** 2),
            )
            for p, sigma, prior in parameter_fields
        )


class AgreementImprovementEntry(Entry):
    """Expected improvement by calibration of the agreement between stations, in distances or in coordinates."""

    before_um: Finite
    """Expected mean disagreement of the stations before calibration [um]."""
    after_um: Finite
    """Expected mean disagreement of the stations after calibration [um]."""
    improvement_percent: Finite
    """Reduction of the mean disagreement by the calibration [%]."""

    @classmethod
    def from_expected_disagreement(cls, expected_disagreement: ExpectedDisagreement) -> dict[str, Self]:
        """Expected improvement in distances (key "distance") and in coordinates of targets (key "coordinate").

        If the disagreement is given for several assumptions on the sizes of the errors, the first assumption is used.
        """
        e = expected_disagreement
        criteria = {
            "distance": (e.distance_disagreement_before, e.distance_disagreement_after, e.distance_improvement),
            "coordinate": (e.coordinate_disagreement_before, e.coordinate_disagreement_after, e.coordinate_improvement),
        }
        return {
            name: cls(before_um=before[0] / MICROMETRE, after_um=after[0] / MICROMETRE, improvement_percent=percent[0])
            for name, (before, after, percent) in criteria.items()
        }


class ProcedureEntry(Entry):
    """Measuring procedure: numbers of faces and rounds, with its duration and the qualities of its layout."""

    faces: int = 1
    """Number of faces: 1 or 2."""
    repeats: int = 1
    """Number of rounds: complete measurements of all targets from a station."""
    pointings: int = 0
    """Number of pointings of the whole measurement."""
    hours: Finite
    """Duration of the whole measurement [h]."""
    qualities: QualityValues = Field(default_factory=dict)
    """Values of the qualities (`instrument`, `targets`, `diagnosis`) with a weight in the goal, by name; smaller is
    better. `targets` is the weighted root mean square point error [m]; the weight of a point is its `weight` divided by
    the square of its tolerance."""

    @staticmethod
    def _procedure_fields(survey: PlannedSurvey, qualities: dict[str, float]) -> dict[str, Any]:
        """Values of the fields on the measuring procedure of a survey, by name of the field, for subclasses."""
        return {
            "faces": len(survey.faces), "repeats": survey.repeats, "pointings": survey.n_pointings,
            "hours": round(survey.duration / 3600, 3), "qualities": qualities,
        }  # fmt: skip


class PlannedLayoutEntry(ProcedureEntry):
    """Planned layout (stations and reflectors) with its expected precision before measurement."""

    broken_rules: tuple[str, ...] = ()
    """Sentence on each rule of the plan that the layout breaks."""
    stations: tuple[PlannedStationEntry, ...]
    """Stations of the layout, with their expected precision."""
    reflectors: tuple[PlannedReflectorEntry, ...] = ()
    """Reflectors of the layout, with their expected precision."""
    rms_sigma_um: OptionalFloat = None
    """Root mean square of `sigma_um` over all reflectors [um], each with equal weight."""
    parameters: tuple[PlannedParameterEntry, ...] = ()
    """Instrument parameters with their expected precision."""
    undetermined: tuple[UndeterminedEntry, ...] = ()
    """Linear combinations of instrument parameters that the layout does not determine."""
    expected_improvement: dict[str, AgreementImprovementEntry] | None = None
    """Expected improvement by calibration of the agreement of the stations, in distances and in coordinates of targets
    (equations 11 and 12 of Sensors 2021, 21, 7479)."""
    blocked_sights: tuple[str, ...] = ()
    """Sentence on each pair of station and reflector without visibility, with the reason."""

    @classmethod
    def from_evaluation(
        cls, layout: LayoutEvaluation, check: ToleranceCheck | None = None, **extra_fields: Any
    ) -> Self:
        """Entry of an evaluated layout, and of the `check` against its tolerances if there are any.

        `extra_fields` are values of the additional fields of a subclass.
        """
        information, survey = layout.expected_precision, layout.survey
        names = information.construction.parameter_names
        return cls(
            broken_rules=tuple(rule.sentence for rule in layout.broken_rules),
            stations=PlannedStationEntry.from_layout(layout),
            reflectors=PlannedReflectorEntry.from_layout(layout, check),
            rms_sigma_um=information.target_rms / MICROMETRE,
            parameters=PlannedParameterEntry.from_expected_precision(information),
            undetermined=tuple(
                UndeterminedEntry(
                    combination=d.coefficients(names), gain=d.gain, cure=m.sentence, measurement=m.instruction
                )
                for d, m in zip(
                    information.undetermined_combinations, information.measurements_for_undetermined(), strict=True
                )
            ),
            expected_improvement=None
            if layout.expected_disagreement is None
            else AgreementImprovementEntry.from_expected_disagreement(layout.expected_disagreement),
            blocked_sights=tuple(layout.visibility.invisible_pair_sentences(survey.station_names, survey.target_names)),
            **cls._procedure_fields(survey, layout.qualities),
            **extra_fields,
        )


class TradeoffEntry(ProcedureEntry):
    """Point of the trade-off curve between cost and quality: number of stations, measuring procedure, best layout."""

    station_count: int
    """Number of stations."""
    objective_value: OptionalFloat = None
    """Value of the objective function for the best layout; smaller is better."""
    is_efficient: bool = False
    """True if every point of the trade-off curve with a shorter duration has a worse objective."""
    layout: tuple[PlannedStationEntry, ...] = ()
    """Stations of the best layout, without their expected precision."""

    @classmethod
    def from_tradeoff_point(cls, tradeoff_point: TradeoffPoint) -> Self:
        """Entry of plan.json for a point of the trade-off curve between cost and quality."""
        return cls(
            station_count=len(tradeoff_point.survey.station_positions),
            objective_value=tradeoff_point.objective_value,
            is_efficient=tradeoff_point.is_efficient,
            layout=PlannedStationEntry.from_survey(tradeoff_point.survey),
            **cls._procedure_fields(tradeoff_point.survey, tradeoff_point.qualities),
        )

    @property
    def point_error_um(self) -> float | None:
        """Weighted point error [um] if the goal is the error of the targets alone; None for another goal."""
        return (
            None
            if self.objective_value is None or set(self.qualities) != {TARGETS_QUALITY_NAME}
            else self.objective_value / MICROMETRE
        )


class LossCheckEntry(Entry):
    """Check whether the tolerances are still met after the loss of a station or a sight."""

    lost_station_or_sight: str
    """Name of the lost station, or description of the lost sight."""
    tolerances_met: bool
    """True if all tolerances are met after the loss of the station or sight."""
    max_tolerance_ratio: OptionalFloat = None
    """Largest ratio of point error to tolerance after the loss; null if a point is undetermined."""
    worst_point: str = ""
    """Name of the point with the largest ratio of point error to tolerance."""
    unseen_points: tuple[str, ...] = ()
    """Names of points with a tolerance that no station sees after the loss."""

    @classmethod
    def from_check(cls, check: ToleranceCheck) -> Self:
        """Entry of the check of the tolerances after the loss of a station or a sight."""
        return cls(
            lost_station_or_sight=check.lost_station_or_sight,
            tolerances_met=check.meets_all_tolerances,
            max_tolerance_ratio=check.max_tolerance_ratio,
            worst_point=check.worst_point_name,
            unseen_points=check.unseen_points,
        )

    @property
    def max_tolerance_ratio_text(self) -> str:
        """Text of the largest ratio of point error to tolerance in percent, "not determined", or "".

        It is "not determined" if a point is undetermined, and empty if no station sees a point.
        """
        if self.max_tolerance_ratio is not None:
            return tolerance_ratio_text(self.max_tolerance_ratio)
        return "" if self.unseen_points else "not determined"


class DetectableSize(Entry):
    """Minimal detectable size of an effect in a layout, for the best, median and worst variant of the effect.

    Variants differ in the station or target where the effect acts, or in shape parameters (period, time constant, onset
    time).
    """

    effect: str
    """Name of the effect, as listed by `ltsim effects`."""
    parameter: str = ""
    """Name of the parameter of the effect whose sizes are listed."""
    unit: str = ""
    """Unit of the sizes."""
    smallest_size: OptionalFloat = None
    """Smallest of the minimal detectable sizes over all stations, targets and shape parameters with which the effect is
    tested."""
    median_size: OptionalFloat = None
    """Median of the minimal detectable sizes over all stations, targets and shape parameters with which the effect is
    tested."""
    largest_size: OptionalFloat = None
    """Largest of the minimal detectable sizes over all stations, targets and shape parameters with which the effect is
    tested."""
    largest_size_at: str = ""
    """Station, target or shape parameters (period, time constant, onset time) with which the effect has the largest
    minimal detectable size."""
    plausible_size: Finite = 0.0
    """Size of the effect in an instrument or hall that is bad, but still plausible."""
    residual_fraction: OptionalFloat = None
    """Fraction of the change of the readings by the effect that remains in the residuals; median over all stations,
    targets and shape parameters with which the effect is tested."""

    @classmethod
    def from_minimal_size(cls, row: MinimalDetectableSize) -> Self:
        """Entry of plan.json for the minimal detectable size of one effect, with sizes in the units of display."""
        factor = SI_PER_UNIT[row.unit]
        return cls(
            effect=row.effect,
            parameter=row.parameter,
            unit=row.unit,
            smallest_size=row.best_size / factor,
            median_size=row.median_size / factor,
            largest_size=row.worst_size / factor,
            largest_size_at=row.worst_variant,
            plausible_size=row.plausible_size / factor,
            residual_fraction=row.residual_fraction,
        )


class ConfusablePair(Entry):
    """Pair of effects that a layout can hardly distinguish, because they change residuals almost equally."""

    effect: str
    """Name of the first effect, as listed by `ltsim effects`."""
    other_effect: str
    """Name of the second effect (as listed by `ltsim effects`), which a diagnosis may report instead of the first."""
    explained_fraction: Finite
    """Fraction of the first effect's change of the residuals that the second effect explains; 1 if it explains
    everything."""

    @classmethod
    def from_pair(cls, pair: tuple[str, str, float]) -> Self:
        """Entry of a `pair`: identifiers of two effects, and the fraction of the first that the second explains."""
        effect, other_effect, explained_fraction = pair
        return cls(effect=effect, other_effect=other_effect, explained_fraction=explained_fraction)
