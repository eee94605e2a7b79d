"""Result of a calibration: estimated instrument parameters, their covariance, and the adjusted network."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import BeforeValidator, Field, PrivateAttr, field_serializer, model_validator

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.evaluation.criteria import CriteriaEntry
from ltsim.adjustment.identification.cause_tests import CauseTest
from ltsim.calibration.arrays import (
    NETWORK_FILE_NAMES,
    CalibrationArrays,
    arrays_from_file_rows,
    residuals_table,
    targets_table,
)
from ltsim.calibration.combinations import DeterminedEntry, UndeterminedEntry
from ltsim.calibration.evidence import determined_combinations, estimates_with_plausible_priors, harmonic_entries
from ltsim.calibration.schema import (
    NOISE_TABLE,
    OUTLIERS_TABLE,
    PARAMETERS_TABLE,
    REFERENCE_VALUES_TABLE,
    REFLECTOR_INCIDENCE_TABLE,
    RESIDUALS_TABLE,
    STATIONS_TABLE,
    TARGETS_TABLE,
    AxesEntry,
    FitEntry,
    FittedEffectEntry,
    HarmonicEntry,
    NoiseRow,
    OutlierRow,
    ParameterEntry,
    RecommendedCorrection,
    ReferenceValueTestEntry,
    ReflectorEntry,
    StationPose,
    VerdictEntry,
)
from ltsim.calibration.uncertainty import UncertaintyEntry, is_noise_estimated, uncertainty_sentences
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.probability import p_value_relation_text, two_sided_p_value
from ltsim.core.results import Table
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.physics.effects.linear_effect import Parameter
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import Finite, ResultFile

EntryT = TypeVar("EntryT", DeterminedEntry, HarmonicEntry)
"""Type of a result entry of which each instrument has several."""
MAX_SIGMA_TO_PRIOR_SIGMA_RATIO = 0.975
"""Largest ratio of posterior to prior standard deviation of a parameter that counts as determined. At this ratio the
readings removed 5 % of the prior variance (0.975 squared is 0.95)."""
FIELDS_NOT_COPIED = frozenset(
    ("format", "files", "construction_name", "parameters", "parameter_covariance", "harmonics", "determined",
     "noise_estimated")
)  # fmt: skip
"""Names of the fields that a changed copy does not take over: computed from arrays, or set when a file is written."""


class Calibration(UncertaintyEntry, ResultFile):
    """Calibration of instruments: result of `calibrate` and `adjust`, with the content of `calibration.json`.

    A file with the names, values and units of the parameters is sufficient to correct a recording.
    """

    FILE: ClassVar[str] = "calibration.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {"targets": TARGETS_TABLE, "residuals": RESIDUALS_TABLE}
    FURTHER_FILES: ClassVar[tuple[str, ...]] = NETWORK_FILE_NAMES
    format: Literal["ltsim-calibration/1"] = "ltsim-calibration/1"
    """Name and version of the file format."""
    method: str = "network"
    """Method of `calibrate` (`network`, `distance`...), or `adjustment`: network adjustment without parameters."""
    construction_name: str = Field(alias="construction")
    """Name of the geometric error model: `misalignment`, `dh`, `steering-mirror` or `ideal`."""
    fit: FitEntry = FitEntry()
    """Fit statistics: chi-square, sigma0, p-value and convergence."""
    frame: str = ""
    """Description of the coordinate frame of the network."""
    parameters: tuple[ParameterEntry, ...]
    """Estimates of the instrument parameters."""
    parameter_covariance: tuple[tuple[Finite, ...], ...] = Field(default=(), alias="covariance")
    """Covariance of the instrument parameters, in the order and the units of `parameters`."""
    harmonics: tuple[HarmonicEntry, ...] = ()
    """Amplitude and phase of each pair of a cosine and a sine parameter."""
    undetermined: tuple[UndeterminedEntry, ...] = ()
    """Combinations of parameters that the recording does not determine."""
    determined: tuple[DeterminedEntry, ...] = ()
    """Combinations of parameters that the recording determines far better than the parameters themselves."""
    stations: tuple[StationPose, ...] = ()
    """Adjusted poses of the stations."""
    criteria: Annotated[CriteriaEntry | None, BeforeValidator(lambda value: value or None)] = None
    """Disagreement of the stations in distances and coordinates, before and after calibration; null for one station."""
    outliers: tuple[OutlierRow, ...] = ()
    """Outlying readings."""
    tests: tuple[CauseTest, ...] = ()
    """Tests of single causes of a misfit (such as a moved station or an outlier)."""
    robust: bool = False
    """True if outlying readings were excluded from the adjustment."""
    noise: tuple[NoiseRow, ...] = ()
    """Noise that was estimated from the readings, one entry per group of readings."""
    fit_with_constants: FitEntry | None = None
    """Fit statistics if the instrument constants are estimated too; null unless the fit without them is rejected."""
    noise_estimated: bool = False
    """True if the adjustment used noise that was estimated from the readings in place of the declared noise."""
    verdict: VerdictEntry = VerdictEntry()
    """Verdict on the test to trust, if the tests of the fit disagree."""
    reference_values: tuple[ReferenceValueTestEntry, ...] = ()
    """Reference coordinates, lengths and levels, each tested against all other observations."""
    undetermined_targets: tuple[str, ...] = ()
    """Names of the targets that their readings do not determine."""
    axes: AxesEntry | None = None
    """Standard deviations of the coordinate axes; null unless declared coordinates define them (`--frame`)."""
    correction: RecommendedCorrection | None = None
    """Recommended correction of readings; null if none was computed."""
    effects: tuple[FittedEffectEntry, ...] = ()
    """Effects and empirical laws (functions such as `elevation ~ time`) that were estimated on request (`--with`)."""
    reflectors: tuple[ReflectorEntry, ...] = ()
    """Estimated incidence errors of the reflectors in fixed nests."""
    has_history_prior: bool = False
    """True if the prior of the parameters comes from earlier calibrations."""
    notes: tuple[str, ...] = ()
    """Notes on how the result was obtained, one sentence each."""
    _arrays: CalibrationArrays | None = PrivateAttr(None)
    _warnings: tuple[str, ...] = PrivateAttr(())

    @model_validator(mode="after")
    def _covariance_is_square(self) -> Self:
        n_parameters = len(self.parameters)
        covariance_rows = self.parameter_covariance
        if covariance_rows and {len(covariance_rows), *map(len, covariance_rows)} != {n_parameters}:
            raise ValueError(f"the covariance is not a matrix of {n_parameters} x {n_parameters} numbers")
        return self

    @field_serializer("criteria")
    def _empty_without_criteria(self, criteria: CriteriaEntry | None) -> CriteriaEntry | dict[str, Any]:
        return {} if criteria is None else criteria

    @classmethod
    def from_arrays(cls, arrays: CalibrationArrays, **fields: Any) -> Self:
        """Calibration result with the given arrays; `fields` are the values of its other fields by their names."""
        factors = np.tile([p.si_per_display_unit for p in arrays.construction.parameters], len(arrays.instruments))
        defaults = {name: entry.get_default(call_default_factory=True) for name, entry in cls.model_fields.items()}
        fields = {name: value for name, value in defaults.items() if name not in FIELDS_NOT_COPIED} | fields
        bayes = fields["method"] == "network" and not fields["has_history_prior"]
        applied_values = arrays.estimates if fields["correction"] is None else arrays.applied_values
        prior = estimates_with_plausible_priors if bayes else None
        derived_fields = {
            "construction_name": arrays.construction.name,
            "parameters": _parameter_entries(arrays, arrays.estimates if applied_values is None else applied_values),
            "parameter_covariance": (arrays.covariance / np.outer(factors, factors)).tolist(),
            "harmonics": _entries_per_instrument(arrays, harmonic_entries),
            "determined": _entries_per_instrument(arrays, determined_combinations, prior),
            "noise_estimated": is_noise_estimated(fields["noise"]),
        }
        result = cls(**fields, **derived_fields)
        result._arrays = arrays
        return result

    def with_changes(self, **changes: Any) -> Self:
        """Copy of the calibration; `changes` are the new values of fields or arrays by their names."""
        array_names = {entry.name for entry in dataclasses.fields(CalibrationArrays)} & changes.keys()
        arrays = replace(self.arrays, **{name: changes.pop(name) for name in array_names})
        return self._with_arrays_and_fields(arrays, **changes)

    def _with_arrays_and_fields(self, arrays: CalibrationArrays, **changes: Any) -> Self:
        """Copy of the calibration with the given arrays; `changes` are new values of other fields by their names."""
        fields = {name: getattr(self, name) for name in type(self).model_fields if name not in FIELDS_NOT_COPIED}
        return type(self).from_arrays(arrays, **{**fields, **changes})

    def with_arrays(self, arrays: CalibrationArrays, warnings: tuple[str, ...] = ()) -> Self:
        """Copy of the calibration with the given arrays, and with warnings for users who apply its parameters."""
        result = self.model_copy()
        result._arrays, result._warnings = arrays, warnings
        return result

    @property
    def arrays(self) -> CalibrationArrays:
        """Parameters and network as arrays in SI units; raises RecordError for a file with invalid parameters."""
        if self._arrays is None:
            covariance = self.parameter_covariance
            self._arrays, _ = arrays_from_file_rows(self.construction_name, self.parameters, covariance, self.FILE)
        return self._arrays

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user of a calibration that was read from a file."""
        return self._warnings

    @property
    def construction(self) -> GeometricErrorModel:
        """Geometric error model whose parameters were estimated."""
        return self.arrays.construction

    @property
    def instruments(self) -> tuple[str, ...]:
        """Names of the instruments; a single unnamed instrument is called ''."""
        return self.arrays.instruments

    @property
    def instrument_parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters of all instruments, with ``@instrument`` if there are several instruments."""
        return self.construction.instrument_parameter_names(self.instruments)

    @property
    def estimates(self) -> Floats:
        """Estimates of the parameters, shape (instruments, parameters) [SI]."""
        return self.arrays.estimates

    @property
    def sigma(self) -> Floats:
        """Standard deviations of the estimates, shape (instruments, parameters) [SI]."""
        return self.arrays.sigma

    @property
    def prior_sigma(self) -> Floats:
        """Prior standard deviations, shape (instruments, parameters) [SI]."""
        return self.arrays.prior_sigma

    @property
    def covariance(self) -> Floats:
        """Covariance of the parameters of all instruments, shape (parameters, parameters) [SI]."""
        return self.arrays.covariance

    @property
    def is_fixed(self) -> Bools:
        """Mask (instruments, parameters) of the parameters that were fixed at a value instead of being estimated."""
        return self.arrays.is_fixed

    @property
    def target_names(self) -> tuple[str, ...]:
        """Names of the targets; none for a calibration that was read from a file."""
        return self.arrays.target_names

    @property
    def target_points(self) -> Floats:
        """Coordinates of the targets, shape (targets, 3) [m]."""
        return self.arrays.target_points

    @property
    def target_covariances(self) -> Floats:
        """Covariance of the coordinates of each target, shape (targets, 3, 3) [m^2]."""
        return self.arrays.target_covariances

    @property
    def adjustment(self) -> Adjustment | None:
        """Adjusted network; None for a calibration that was read from a file."""
        return self.arrays.adjustment

    @property
    def applied_values(self) -> Floats:
        """Parameters that a correction removes from readings, shape (instruments, parameters) [SI]."""
        applied = self.arrays.applied_values
        return self.estimates if self.correction is None or applied is None else applied

    @property
    def is_rejected(self) -> bool:
        """True if the readings contradict the model: sigma0 is significantly above 1, not because of a few readings."""
        return self.uncertainty_factor > 1.0

    def _summary_lines(self) -> list[str]:
        fit, count = self.fit, len(self.instrument_parameter_names)
        test = f"chi2/dof {fit.chi2:.1f}/{fit.dof}"
        test += "" if fit.p_value is None else f", two-sided {p_value_relation_text(two_sided_p_value(fit.p_value))}"
        n_determined = int(((self.sigma < MAX_SIGMA_TO_PRIOR_SIGMA_RATIO * self.prior_sigma) & ~self.is_fixed).sum())
        targets = f" and {len(self.target_names)} targets" if self.target_names else ""
        lines = [f"Calibration ({self.method}, {self.construction_name}): {fit.status}, {test}"]
        lines.append(f"{len(self.stations)} stations{targets} in {self.frame}")
        if count:
            undetermined = f"undetermined combinations: {len(self.undetermined)}"
            held = f" ({int(self.is_fixed.sum())} fixed)" if self.is_fixed.any() else ""
            lines.append(f"{count} parameters{held}, {n_determined} determined by the readings; {undetermined}")
        lines += [effect.sentence for effect in self.effects]
        if self.outliers:
            lines.append(f"{len(self.outliers)} outlying readings")
        if self.criteria is not None:
            lines.append(f"stations disagree in distances by {self.criteria.distance.text}")
        if self.correction is not None and self.correction.uncorrected_error_um > 0:
            lines += [*([] if self.is_rejected else [self.correction.point_error_text]), *self.correction.sentences]
        return [*lines, *uncertainty_sentences(self), *self.notes, *self.warnings]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        tables: dict[str, Callable[[], Table]] = {
            "parameters": lambda: PARAMETERS_TABLE.with_rows(self.parameters),
            "targets": lambda: targets_table(self.target_names, self.target_points, self.target_covariances),
            "stations": self._stations_table,
            "outliers": lambda: OUTLIERS_TABLE.with_rows(self.outliers),
            "noise": lambda: NOISE_TABLE.with_rows(self.noise),
            "reference_values": lambda: REFERENCE_VALUES_TABLE.with_rows(self.reference_values),
            "reflectors": lambda: REFLECTOR_INCIDENCE_TABLE.with_rows(
                [entry.reflector, p.name, p.value, p.sigma] for entry in self.reflectors for p in entry.parameters
            ),
        }
        adjustment = self.adjustment
        if adjustment is not None:
            tables["residuals"] = lambda: residuals_table(adjustment)
        if not self.instrument_parameter_names:
            del tables["parameters"]
        return tables

    def _stations_table(self) -> Table:
        sigma = [s.sigma_position_mm or (None,) * 3 for s in self.stations]
        stations_with_sigma = zip(self.stations, sigma, strict=True)
        return STATIONS_TABLE.with_rows([s.name, *s.position_mm, *sigmas] for s, sigmas in stations_with_sigma)

    @property
    def applied_reflectors(self) -> dict[str, Floats]:
        """Parameters (14,) [SI] of incidence errors, by the reflector's name, that a correction removes from readings.

        The incidence errors are removed together with the instrument parameters, or not at all.
        """
        if not np.any(self.applied_values):
            return {}
        sizes = {entry.reflector: {p.name: p.value for p in entry.parameters} for entry in self.reflectors}
        return {
            name: np.array([float(values.get(p.name, 0.0)) * p.si_per_display_unit for p in SmrIncidence.parameters])
            for name, values in sizes.items()
        }

    def for_instrument(self, instrument: int, parameter_indices: Ints) -> Self:
        """Calibration of the instrument with index `instrument`, reduced to the parameters `parameter_indices`."""
        return self._with_arrays_and_fields(self.arrays.for_instrument(instrument, parameter_indices), correction=None)

    def applied_values_for(self, recording: Recording) -> Floats:
        """Parameters [SI], (parameters,) or (pointings, parameters), that a correction removes from a recording.

        Parameters of a single instrument apply to every recording. Parameters of several instruments apply to the
        instruments with their names.

        Raises
        ------
        RecordError
            When the calibration has no parameters of an instrument of the recording.
        """
        if len(self.instruments) == 1:
            return self.applied_values[0]
        unknown = [name for name in recording.instruments if name not in self.instruments]
        if unknown:
            names = ", ".join(self.instruments)
            raise RecordError(f"instrument '{unknown[0]}' of the recording is not in the calibration ({names})")
        indices = np.array([self.instruments.index(name) for name in recording.instruments])
        return self.applied_values[indices[recording.instrument]]


def _parameter_entries(arrays: CalibrationArrays, applied_values: Floats) -> tuple[ParameterEntry, ...]:
    """Result entries of the parameters, with `applied_values` [SI] where they differ from the estimates."""
    is_multiple = len(arrays.instruments) > 1
    parameter_entries = []
    for i, instrument in enumerate(arrays.instruments):
        for k, parameter in enumerate(arrays.construction.parameters):
            value, sigma, factor = arrays.estimates[i, k], arrays.sigma[i, k], parameter.si_per_display_unit
            differs = abs(applied_values[i, k] - value) > SQRT_MACHINE_EPSILON * max(abs(value), sigma)
            entry = ParameterEntry(
                name=parameter.name,
                value=float(value / factor),
                sigma=float(sigma / factor),
                unit=parameter.unit,
                prior_sigma=float(arrays.prior_sigma[i, k] / factor),
                held=bool(arrays.is_fixed[i, k]),
                prior_rejected=bool(arrays.is_prior_rejected[i, k]),
            )
            further = {"applied_value": float(applied_values[i, k] / factor)} if differs else {}
            named = {"instrument": instrument} if is_multiple else {}
            parameter_entries.append(entry.model_copy(update={**further, **named}))
    return tuple(parameter_entries)


def _entries_per_instrument(
    arrays: CalibrationArrays,
    make_entries: Callable[[Sequence[Parameter], Floats, Floats], list[EntryT]],
    transform: Callable[[Sequence[Parameter], Floats, Floats, Floats], tuple[Floats, Floats]] | None = None,
) -> tuple[EntryT, ...]:
    """Result entries of all instruments, from the estimates and covariance of each (after `transform`, if given)."""
    several, size = len(arrays.instruments) > 1, arrays.construction.n_parameters
    flat_entries: list[EntryT] = []
    parameters = arrays.construction.parameters
    for i, (name, values) in enumerate(zip(arrays.instruments, arrays.estimates, strict=True)):
        covariance = arrays.covariance[i * size : (i + 1) * size, i * size : (i + 1) * size]
        if transform is not None:
            values, covariance = transform(parameters, values, covariance, arrays.effective_prior_sigma[i])
        entries = make_entries(parameters, values, covariance)
        flat_entries += [entry.model_copy(update={"instrument": name}) if several else entry for entry in entries]
    return tuple(flat_entries)
