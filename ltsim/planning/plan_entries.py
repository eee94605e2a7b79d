"""Entries of plan.json, each created from a part of the planned network."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pydantic import Field

from ltsim.calibration.combinations import UndeterminedEntry
from ltsim.core.units import FACTOR, MICROMETRE, MILLIMETRE
from ltsim.planning.objective import TARGETS
from ltsim.planning.plan_change import in_degrees, in_millimetres
from ltsim.planning.tolerances import ToleranceCheck, is_met, percent
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, Positive, Vector

if TYPE_CHECKING:
    from ltsim.adjustment.remedies.detectability import MinimalSize
    from ltsim.planning.information import ExpectedErrors, LayoutInformation
    from ltsim.planning.planner import LayoutEvaluation, TradeoffPoint
    from ltsim.planning.survey import Survey

Qualities = dict[str, OptionalFloat]
Sizes = tuple[OptionalFloat, OptionalFloat, OptionalFloat] | tuple[()]
"""Sizes along x, y and z, or an empty tuple."""


class StationEntry(Entry):
    """Station of a plan."""

    name: str
    """Name of the station."""
    position_mm: Vector
    """Centre of the head, in the workshop's frame."""
    yaw_deg: Finite
    """Direction of azimuth zero, counter-clockwise from x."""
    sigma_position_um: Sizes = ()
    """Expected standard deviation of x, y and z."""
    visible_reflectors: int = 0
    """Number of reflectors that the station sees."""

    @classmethod
    def places(cls, survey: Survey) -> tuple[Self, ...]:
        """Entries of the stations of a survey, without their precision."""
        rows = zip(survey.station_names, survey.position, survey.yaw, strict=True)
        return tuple(
            cls(name=name, position_mm=in_millimetres(place), yaw_deg=in_degrees(yaw)) for name, place, yaw in rows
        )

    @classmethod
    def of(cls, layout: LayoutEvaluation) -> tuple[Self, ...]:
        """Entries of the stations of a layout, with their expected precision."""
        sigma = np.sqrt(np.einsum("sii->si", layout.information.pose_covariance[:, :3, :3])) / MICROMETRE
        counts = layout.survey.visible.sum(axis=1).tolist()
        return tuple(
            cls(
                name=place.name,
                position_mm=place.position_mm,
                yaw_deg=place.yaw_deg,
                sigma_position_um=tuple(np.round(station_sigma, 2).tolist()),
                visible_reflectors=count,
            )
            for place, station_sigma, count in zip(cls.places(layout.survey), sigma, counts, strict=True)
        )


class ReflectorEntry(Entry):
    """A reflector with its expected precision."""

    name: str
    """Name of the reflector."""
    position_mm: Vector
    """Centre of the reflector, in the workshop's frame."""
    sigma_um: OptionalFloat
    """Expected standard deviation of the point: square root of the trace of its covariance."""
    u_um: Sizes = Field(default=(), alias="U_um")
    """Expanded uncertainty (k = 2) of x, y and z, datum the mean of all points."""
    stations_seeing: int = 0
    """Number of stations that see the reflector."""
    visible_from: tuple[str, ...] = ()
    """Names of the stations that see the reflector."""
    within_mm: OptionalFloat = None
    """Distance that the point error does not exceed at the confidence level of the goal; null without a tolerance."""
    tolerance_mm: OptionalFloat = None
    """Tolerance of the point error."""
    used: OptionalFloat = None
    """Ratio of point error to tolerance, `within_mm` / `tolerance_mm`; at most 1 if the tolerance is met."""
    met: bool | None = None
    """True if the tolerance is met; null without one."""

    @classmethod
    def of(cls, layout: LayoutEvaluation, check: ToleranceCheck | None) -> tuple[Self, ...]:
        """Entries of the reflectors of a layout with expected precision, and with tolerances if it has a check."""
        survey, information = layout.survey, layout.information
        expanded = 2.0 * np.sqrt(np.einsum("tii->ti", information.target_covariance)) / MICROMETRE
        return tuple(
            cls(
                name=name,
                position_mm=in_millimetres(survey.points[t], 3),
                sigma_um=round(float(information.target_sigma[t]) / MICROMETRE, 2),
                U_um=tuple(np.round(expanded[t], 2).tolist()),
                stations_seeing=int(survey.visible[:, t].sum()),
                visible_from=tuple(survey.station_names[s] for s in np.flatnonzero(survey.visible[:, t])),
                **cls._against(name, check),
            )
            for t, name in enumerate(survey.target_names)
        )

    @staticmethod
    def _against(name: str, check: ToleranceCheck | None) -> dict[str, Any]:
        """Fields of a point with a tolerance; empty for another point."""
        if check is None or name not in check.radius:
            return {}
        within, used = check.radius[name] / MILLIMETRE, check.used(name)
        return {
            "within_mm": within, "tolerance_mm": check.tolerance[name] / MILLIMETRE, "used": used, "met": is_met(used),
        }  # fmt: skip


class PlannedParameterEntry(Entry):
    """An instrument parameter with its expected precision."""

    name: str
    """Name of the parameter."""
    unit: str = ""
    """Unit of both standard deviations."""
    sigma: Finite
    """Expected standard deviation after calibration."""
    prior_sigma: Positive
    """Standard deviation before any reading."""
    gain: OptionalFloat = None
    """Fraction of the prior variance that the readings would remove."""

    @classmethod
    def of(cls, information: LayoutInformation) -> tuple[Self, ...]:
        """Entries of the instrument's parameters in units of display."""
        rows = zip(
            information.construction.parameters, information.instrument_sigma, information.prior_sigma, strict=True
        )
        return tuple(
            cls(
                name=p.name,
                unit=p.unit,
                sigma=float(sigma / p.si_per_display_unit),
                prior_sigma=float(prior / p.si_per_display_unit),
                gain=float(1.0 - (sigma / prior) ** 2),
            )
            for p, sigma, prior in rows
        )


class ImprovementEntry(Entry):
    """Expected improvement of a criterion of the paper."""

    before_um: Finite
    """Expected mean before calibration."""
    after_um: Finite
    """Expected mean after calibration."""
    improvement_percent: Finite
    """Reduction of the mean by the calibration."""

    @classmethod
    def of(cls, expected: ExpectedErrors) -> dict[str, Self]:
        """Both criteria of one request, by name."""
        e = expected
        criteria = {
            "distance": (e.distance_before, e.distance_after, e.distance_improvement),
            "coordinate": (e.coordinate_before, e.coordinate_after, e.coordinate_improvement),
        }
        return {
            name: cls(before_um=before[0] / MICROMETRE, after_um=after[0] / MICROMETRE, improvement_percent=percent[0])
            for name, (before, after, percent) in criteria.items()
        }


class WorkEntry(Entry):
    """Measuring procedure: numbers of faces and rounds, and duration."""

    faces: int = 1
    """Number of faces: 1 or 2."""
    repeats: int = 1
    """Number of rounds."""
    pointings: int = 0
    """Number of pointings."""
    hours: Finite
    """Duration of the whole measurement [h]."""
    quality: Qualities = Field(default_factory=dict)
    """Qualities with a weight in the goal, by name; smaller is better."""

    @staticmethod
    def _work(survey: Survey, qualities: dict[str, float]) -> dict[str, Any]:
        """Fields of the measuring procedure of a survey."""
        return {
            "faces": len(survey.faces), "repeats": survey.repeats, "pointings": survey.pointings,
            "hours": round(survey.seconds / 3600, 3), "quality": qualities,
        }  # fmt: skip


class LayoutEntry(WorkEntry):
    """Layout with its expected precision before measurement."""

    broken_rules: tuple[str, ...] = ()
    """Rules of the plan that the layout breaks, one sentence each."""
    stations: tuple[StationEntry, ...]
    """Stations of the layout."""
    reflectors: tuple[ReflectorEntry, ...] = ()
    """Reflectors of the mesh."""
    parameters: tuple[PlannedParameterEntry, ...] = ()
    """Instrument parameters with their expected precision."""
    undetermined: tuple[UndeterminedEntry, ...] = ()
    """Undetermined combinations of instrument parameters."""
    expected_improvement: dict[str, ImprovementEntry] | None = None
    """Expected improvement, by the paper's criteria."""
    blocked_sights: tuple[str, ...] = ()
    """Station and reflector pairs without visibility, with the reason, one sentence each."""

    @classmethod
    def of_layout(cls, layout: LayoutEvaluation, check: ToleranceCheck | None = None, **further: Any) -> Self:
        """Entry of a layout, with a check against its tolerances; `further` are the additional fields of a subclass."""
        information, survey = layout.information, layout.survey
        names = information.construction.parameter_names
        return cls(
            broken_rules=tuple(rule.words for rule in layout.broken),
            stations=StationEntry.of(layout),
            reflectors=ReflectorEntry.of(layout, check),
            parameters=PlannedParameterEntry.of(information),
            undetermined=tuple(
                UndeterminedEntry(combination=d.coefficients(names), gain=d.gain, cure=cure)
                for d, cure in zip(information.undetermined, information.cures(), strict=True)
            ),
            expected_improvement=None if layout.expected is None else ImprovementEntry.of(layout.expected),
            blocked_sights=tuple(layout.table.lost(survey.station_names, survey.target_names)),
            **cls._work(survey, layout.qualities),
            **further,
        )


class OptionEntry(WorkEntry):
    """Measuring procedure with its best layout."""

    stations: int
    """Number of stations."""
    value: OptionalFloat = None
    """Objective of the layout; smaller is better."""
    efficient: bool = False
    """True if no cheaper procedure is as good."""
    layout: tuple[StationEntry, ...] = ()
    """Stations of the layout."""

    @classmethod
    def of(cls, option: TradeoffPoint) -> Self:
        """Entry of a point on the curve of cost against quality."""
        return cls(
            stations=len(option.survey.position),
            value=option.value,
            efficient=option.efficient,
            layout=StationEntry.places(option.survey),
            **cls._work(option.survey, option.qualities),
        )

    @property
    def value_um(self) -> float | None:
        """Objective in micrometres if the goal is the error of the targets alone; None for another goal."""
        return None if self.value is None or set(self.quality) != {TARGETS} else self.value / MICROMETRE


class LossEntry(Entry):
    """Check of the tolerances after the loss of a station or a sight."""

    lost: str
    """Text of the lost station or sight."""
    met: bool
    """True if all tolerances are met after the loss."""
    ratio: OptionalFloat = None
    """Largest ratio of point error to tolerance; null if a point is undetermined."""
    worst: str = ""
    """Point with the largest ratio."""
    unseen: tuple[str, ...] = ()
    """Points with a tolerance that no station sees after the loss."""

    @classmethod
    def of(cls, check: ToleranceCheck) -> Self:
        """Entry of a check after a loss."""
        return cls(lost=check.lost, met=check.good, ratio=check.ratio, worst=check.worst, unseen=check.unseen)

    @property
    def used(self) -> str:
        """Text of the ratio in percent, of an undetermined network, or empty for a hidden point."""
        if self.ratio is not None:
            return percent(self.ratio)
        return "" if self.unseen else "not determined"


class DetectableSize(Entry):
    """Minimal detectable size of an effect in a layout, at the best, median and worst place."""

    effect: str
    """Identifier of the effect in the catalogue."""
    parameter: str = ""
    """Name of the parameter."""
    unit: str = ""
    """Unit of the sizes."""
    best: OptionalFloat = None
    """Minimal detectable size at the best place or shape."""
    typical: OptionalFloat = None
    """Minimal detectable size at the median place or shape."""
    worst: OptionalFloat = None
    """Minimal detectable size at the worst place or shape."""
    worst_at: str = ""
    """Worst place or shape: station, target or shape."""
    plausible: Finite = 0.0
    """Large but plausible size of the effect."""
    visible: OptionalFloat = None
    """Median fraction of the effect's signature that remains in the residuals."""

    @classmethod
    def of(cls, row: MinimalSize) -> Self:
        """Entry of a minimal detectable size in units of display."""
        factor = FACTOR[row.unit]
        return cls(
            effect=row.effect,
            parameter=row.parameter,
            unit=row.unit,
            best=row.best_size / factor,
            typical=row.median_size / factor,
            worst=row.worst_size / factor,
            worst_at=row.worst_place,
            plausible=row.prior_sigma / factor,
            visible=row.visible_fraction,
        )


class ConfusablePair(Entry):
    """Pair of effects that a layout can hardly distinguish.

    `share` is the fraction of the first's signature that the second explains.
    """

    effect: str
    """Identifier of the effect in the catalogue."""
    taken_for: str
    """Identifier of the effect that explains the signature too."""
    share: Finite
    """Fraction of the signature that the second effect explains; 1 for all of it."""

    @classmethod
    def of(cls, pair: tuple[str, str, float]) -> Self:
        """Entry of a pair in a detectability report."""
        effect, taken_for, share = pair
        return cls(effect=effect, taken_for=taken_for, share=share)
