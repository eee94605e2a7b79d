"""Prior information of a calibration: parameters to estimate, fixed values, and results of earlier calibrations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ltsim.adjustment.prior import ParameterPrior, prior_sigmas
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import read_calibration
from ltsim.calibration.history import History
from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, ModelError, RecordError, unknown_name_error
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.model.construction import GeometricErrorModel, all_instrument_parameter_names
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import read_json, read_result

NO_PRIOR_SIGMA_FACTOR = 1000.0
"""Factor on the prior standard deviations in `setup.toml` for a calibration without a prior. The resulting standard
deviations are 10 to 20 mm and 15 mrad, for which the linearisation is still valid."""


@dataclass(frozen=True)
class EarlierCalibrationPrior:
    """Prior from earlier calibrations: mean and covariance of the parameters of one or several instruments."""

    construction: str
    """Name of the geometric error model of the earlier calibrations."""
    parameters: tuple[str, ...]
    """Names of the parameters."""
    instruments: tuple[str, ...]
    """Names of the instruments. A prior of a single instrument applies to every instrument of a recording."""
    mean: Floats
    """Mean of the parameters, shape (instruments, parameters) [SI]."""
    covariance: Floats
    """Covariance of the parameters of each instrument, shape (instruments, parameters, parameters) [SI]."""
    between_calibration_sigma: Floats
    """Standard deviation of each parameter between calibrations [SI]; 0 for a single calibration."""
    n_calibrations: int = 1
    """Number of earlier calibrations."""

    @classmethod
    def from_source(
        cls, source: Calibration | History | EarlierCalibrationPrior | str | Path
    ) -> EarlierCalibrationPrior:
        """Prior from a calibration or history, or from the file of one; raises RecordError for other files."""
        if isinstance(source, EarlierCalibrationPrior):
            return source
        if isinstance(source, Calibration):
            return cls._from_calibration(source)
        if isinstance(source, History):
            return cls._from_history(source)
        path = Path(source)
        names = (Calibration.FILE, History.FILE)
        existing_files = [path / name for name in names if (path / name).is_file()] or [path / names[0]]
        file = existing_files[0] if path.is_dir() else path
        if str(read_json(file, Calibration.FILE).get("format", "")).startswith("ltsim-history/"):
            return cls._from_history(read_result(file, History), file)
        return cls._from_calibration(read_calibration(file))

    @classmethod
    def _from_calibration(cls, calibration: Calibration) -> EarlierCalibrationPrior:
        """Prior from a single calibration, without its fixed parameters."""
        free_indices = np.flatnonzero(~calibration.is_fixed.any(axis=0) & (calibration.sigma > 0).all(axis=0))
        count, size = calibration.estimates.shape
        blocks = calibration.covariance.reshape(count, size, count, size)
        covariances = np.stack([blocks[i, :, i][np.ix_(free_indices, free_indices)] for i in range(count)])
        names = tuple(calibration.construction.parameter_names[k] for k in free_indices)
        return cls(
            calibration.construction.name,
            names,
            calibration.instruments,
            calibration.estimates[:, free_indices],
            covariances,
            np.zeros(len(free_indices)),
        )

    @classmethod
    def _from_history(cls, content: History, file: Path | None = None) -> EarlierCalibrationPrior:
        """Prior from a history: mean parameters, their covariance, and standard deviations between calibrations."""
        courses = content.parameters
        unsupported = next((course for course in courses if course.unit not in SI_PER_UNIT), None)
        if unsupported is not None:
            raise RecordError(f"parameters: unknown unit '{unsupported.unit}' of {unsupported.name}", file=file)
        if np.shape(content.mean_covariance) != (len(courses), len(courses)):
            raise RecordError("the file has no covariance of the means; write it again with `ltsim history`", file=file)
        factor = np.array([SI_PER_UNIT[course.unit] for course in courses])
        mean = np.array([course.mean for course in courses]) * factor
        spread = np.array([course.between_calibration_sigma for course in courses]) * factor
        covariance = np.diag(spread**2) + np.array(content.mean_covariance) * np.outer(factor, factor)
        names = tuple(course.name for course in courses)
        return cls(content.construction, names, ("",), mean[None], covariance[None], spread, len(content.calibrations))

    def replace_nominal_prior(
        self, nominal_prior: ParameterPrior, construction: GeometricErrorModel, instruments: tuple[str, ...]
    ) -> ParameterPrior:
        """Prior of the instruments of a recording, with mean and covariance from the earlier calibrations.

        Parameters that the earlier calibrations lack keep their prior of `nominal_prior`.

        Raises
        ------
        RecordError
            For another geometric error model or other instruments.
        """
        common_names = [name for name in construction.parameter_names if name in self.parameters]
        if not common_names:
            raise RecordError(
                f"the construction {self.construction} of the earlier calibrations has no parameter of "
                f"{construction.name}"
            )
        new_indices = [construction.parameter_names.index(name) for name in common_names]
        their_indices = [self.parameters.index(name) for name in common_names]
        mean, covariance = nominal_prior.mean.copy(), nominal_prior.covariance.copy()
        for i, name in enumerate(instruments):
            if len(self.instruments) > 1 and name not in self.instruments:
                names = ", ".join(self.instruments)
                raise RecordError(f"earlier calibrations have the instruments {names}, not '{name}'")
            k = 0 if len(self.instruments) == 1 else self.instruments.index(name)
            mean[i, new_indices] = self.mean[k, their_indices]
            covariance[i][np.ix_(new_indices, new_indices)] = self.covariance[k][np.ix_(their_indices, their_indices)]
        return ParameterPrior(mean, covariance, nominal_prior.is_fixed)


@dataclass(frozen=True)
class ParameterSelection:
    """Selection of the parameters to estimate and of their prior; by default all, with the prior in `setup.toml`.

    A name selects one parameter (`beam-tilt`), all parameters that begin with it (`azimuth-eccentricity`, `J1.eX`), or
    the parameter of one instrument (`beam-tilt@TRACKER`).
    """

    estimated_parameters: Sequence[str] | None = None
    """Names of the parameters to estimate; all others are fixed at zero. None selects all parameters."""
    excluded_parameters: Sequence[str] = ()
    """Names of the parameters that are fixed at zero."""
    fixed_values: Mapping[str, float] = field(default_factory=dict)
    """Value of each parameter that is fixed at a value, in its display unit, by the name of the parameter."""
    earlier_calibration_prior: EarlierCalibrationPrior | None = None
    """Prior from earlier calibrations that replaces the prior in `setup.toml`."""
    has_no_prior: bool = False
    """True for a calibration without a prior: the prior standard deviations of the recording's `setup.toml`
    (declared or default) are then multiplied by `NO_PRIOR_SIGMA_FACTOR`."""

    def prior_of(self, recording: Recording, construction: GeometricErrorModel) -> ParameterPrior:
        """Prior of a recording's instruments with this selection; raises ModelError or InputError for wrong names."""
        return self.prior_with_sigma(prior_sigmas(recording, construction), recording, construction)

    def prior_with_sigma(
        self, sigma: Floats, recording: Recording, construction: GeometricErrorModel
    ) -> ParameterPrior:
        """Prior of a recording's instruments with this selection and with the sigmas (instruments, parameters) [SI]."""
        check_prior_names(recording, construction)
        nominal_prior = ParameterPrior.from_sigmas(sigma * (NO_PRIOR_SIGMA_FACTOR if self.has_no_prior else 1.0))
        if self.earlier_calibration_prior is not None:
            nominal_prior = self.earlier_calibration_prior.replace_nominal_prior(
                nominal_prior, construction, recording.instruments
            )

        def indices_of(*parameters_or_prefixes: str) -> list[int]:
            return [
                k
                for name in parameters_or_prefixes
                for k in parameter_vector_indices(name, construction.parameter_names, recording.instruments)
            ]

        is_fixed = np.zeros(nominal_prior.mean.shape, dtype=bool)
        prior_means = np.zeros(nominal_prior.mean.shape)
        if self.estimated_parameters is not None:
            is_fixed[:] = True
            is_fixed.flat[indices_of(*self.estimated_parameters)] = False
        is_fixed.flat[indices_of(*self.excluded_parameters)] = True
        for name, value in self.fixed_values.items():
            at = indices_of(name)
            if len({k % construction.n_parameters for k in at}) > 1:
                raise ModelError(f"'{name}' names several parameters; expected one parameter for a value")
            is_fixed.flat[at] = True
            prior_means.flat[at] = (
                float(value) * construction.parameters[at[0] % construction.n_parameters].si_per_display_unit
            )
        if is_fixed.all():
            raise ModelError("all parameters are fixed; leave at least one to estimate")
        # Held parameters carry no information on the others.
        covariance, diagonal = nominal_prior.covariance.copy(), np.eye(construction.n_parameters, dtype=bool)
        covariance[(is_fixed[:, :, None] | is_fixed[:, None, :]) & ~diagonal] = 0.0
        return ParameterPrior(np.where(is_fixed, prior_means, nominal_prior.mean), covariance, is_fixed)


def parameter_vector_indices(
    parameter_or_prefix: str, parameters: Sequence[str], instruments: Sequence[str]
) -> list[int]:
    """Indices of a parameter, or of all that begin with a prefix, in the vector of all instruments' parameters.

    Raises ModelError if no parameter has this name or prefix.
    """
    name, at, instrument = parameter_or_prefix.strip().partition("@")
    if at and instrument not in instruments:
        raise unknown_name_error("instrument", instrument, [label or "unnamed" for label in instruments])
    matches = [k for k, p in enumerate(parameters) if p == name]
    matches = matches or [k for k, p in enumerate(parameters) if p.startswith((name + "-", name + "_", name + "."))]
    if not matches:
        raise unknown_name_error("parameter", name, parameters)
    instrument_indices = [instruments.index(instrument)] if at else range(len(instruments))
    return [i * len(parameters) + k for i in instrument_indices for k in matches]


def check_prior_names(recording: Recording, construction: GeometricErrorModel) -> None:
    """Check that `setup.toml` declares priors only for parameters of `construction`; raises InputError otherwise."""
    setup = recording.setup
    tables = {"instrument": setup.instrument, **{f"instruments.{k}": i for k, i in setup.instruments.items()}}
    parameter_names = {*construction.parameter_names, *all_instrument_parameter_names()}
    for table, instrument in tables.items():
        for name in instrument.prior.parameters:
            if name not in parameter_names:
                raise InputError(
                    f"[{table}.prior.parameters]: {unknown_name_error('parameter', name, construction.parameter_names)}"
                )
