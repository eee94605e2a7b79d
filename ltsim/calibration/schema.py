"""Entries and tables of `calibration.json`."""

import math
from typing import Literal, Self

import numpy as np
from scipy import special

from ltsim.adjustment.verdict import Verdict
from ltsim.core.arrays import Floats
from ltsim.core.notation import number_text, with_sigma
from ltsim.core.probability import p_value_relation_text
from ltsim.core.results import Column, Table, model_columns, number_columns, text_columns
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.recordings.result_file import Entry, Finite, NotNegative, OptionalFloat, Positive, Quaternion, Sigma, Vector

OBSERVABLE_DISPLAY_UNITS = (("mm", MILLIMETRE), ("arcsec", ARCSECOND), ("arcsec", ARCSECOND))
"""Name and SI value of the display unit of each observable: range, azimuth, elevation."""

COORDINATE_COLUMNS = (
    *text_columns(target="name"),
    *number_columns(".6f", x_mm="coordinate", y_mm="coordinate", z_mm="coordinate"),
    *number_columns(".6f", sigma_x_mm="its standard deviation", sigma_y_mm="as sigma_x_mm", sigma_z_mm="as sigma_x_mm"),
)
TARGETS_TABLE = Table("targets.csv", "adjusted targets; undetermined ones have no row or no height", COORDINATE_COLUMNS)
RESIDUALS_TABLE = Table(
    "residuals.csv",
    "one row per observation in use",
    (
        *number_columns(row="row number in `observations.csv`, from 1"),
        *text_columns(station="name", target="name"),
        *number_columns(face="1 or 2", repeat="repetition, from 1"),
        *text_columns(observable="distance, azimuth or elevation"),
        *number_columns(".6g", residual="observed minus adjusted, in `unit`"),
        *text_columns(unit="unit of the residual"),
        *number_columns(
            ".4f", redundancy="part of an error of the reading that its residual shows, 0 to 1", w="normalised residual"
        ),
    ),
)


class FitEntry(Entry):
    """Statistics of the misfit of readings and model; sigma0 and the p-value are null without redundancy."""

    chi2: Finite = 0.0
    """Chi-square: weighted sum of squared residuals."""
    dof: int = 0
    """Degrees of freedom."""
    sigma0: OptionalFloat = None
    """Square root of chi-square divided by the degrees of freedom."""
    p_value: OptionalFloat = None
    """Probability of a chi-square at least this large; near 1 if readings scatter less than declared. Texts show the
    two-sided p-value."""
    iterations: int = 0
    """Number of Gauss-Newton steps."""
    status: str = "not declared"
    """`converged`, or the reason why the iteration did not converge."""
    sentence: str = ""
    """Sentence for users on the convergence."""
    chi2_sigma: OptionalFloat = None
    """Expected standard deviation of chi-square; null if it is the square root of 2 dof."""


class ParameterEntry(Entry):
    """Estimate of an instrument parameter in its display unit."""

    name: str
    """Name of the parameter in the geometric error model, as in `ltsim effects`."""
    value: Finite
    """Estimate, with the sign of a correction: true value minus reading."""
    sigma: Sigma = None
    """Standard deviation of the estimate."""
    unit: str
    """Unit of value and standard deviations."""
    prior_sigma: Positive | None = None
    """Prior standard deviation of the parameter, in `unit`."""
    held: bool = False
    """True if the parameter was not estimated but fixed at `value`."""
    prior_rejected: bool = False
    """True if the readings contradict the prior, so that the prior hardly influences the estimate."""
    applied_value: OptionalFloat = None
    """Correction (true minus reading) that is applied to readings, in `unit`; null if it equals `value`. A smaller
    value than `value` is applied if it is expected to make points more accurate. For a parameter that the readings
    hardly determine, the prior mean is applied."""
    instrument: str = ""
    """Name of the instrument; empty for a single unnamed instrument."""

    @property
    def variance_reduction(self) -> float:
        """Fraction by which the readings reduce the prior variance; 1 without a prior."""
        return 1.0 if not self.prior_sigma or self.sigma is None else 1.0 - (self.sigma / self.prior_sigma) ** 2


class HarmonicEntry(Entry):
    """Amplitude and phase of a harmonic from its cosine and sine; the phase is null for an insignificant amplitude."""

    name: str
    """Name of the harmonic: the common part of the names of both parameters."""
    amplitude: Finite
    """Amplitude of the harmonic, in `unit`."""
    sigma: Sigma
    """Standard deviation of the amplitude, in `unit`."""
    unit: str
    """Unit of the amplitude and of its standard deviation."""
    phase_deg: OptionalFloat = None
    """Phase of the harmonic [deg]: angle at which the harmonic has its maximum."""
    sigma_phase_deg: OptionalFloat = None
    """Standard deviation of the phase [deg]."""
    instrument: str = ""
    """Name of the instrument; empty for a single unnamed instrument."""


class StationPose(Entry):
    """Adjusted pose of a station: position [mm], and rotation from instrument to network as a quaternion x y z w."""

    name: str
    """Name of the station."""
    position_mm: tuple[OptionalFloat, OptionalFloat, OptionalFloat]
    """Position [mm] in the frame of the network; the height is null if the station was adjusted in plan only."""
    rotation_quaternion: Quaternion = (0.0, 0.0, 0.0, 1.0)
    """Rotation from instrument to network, as a quaternion x y z w."""
    sigma_position_mm: tuple[OptionalFloat, OptionalFloat, OptionalFloat] | None = None
    """Standard deviation of each coordinate [mm]; 0 for a coordinate that defines the frame."""
    sigma_rotation_arcsec: tuple[OptionalFloat, OptionalFloat, OptionalFloat] | None = None
    """Standard deviation of the rotation about each axis [arcsec]; 0 for a rotation that defines the frame."""

    @property
    def position(self) -> Floats:
        """Position (3,) [m]; 0 for an undetermined height."""
        return np.nan_to_num(np.array(self.position_mm, dtype=np.float64)) * MILLIMETRE

    @property
    def quaternion(self) -> Floats:
        """Rotation from instrument to network, as a quaternion (4,) x, y, z, w."""
        return np.array(self.rotation_quaternion)

    @property
    def sigma_position(self) -> Floats:
        """Standard deviation of the position, (3,) [m]; NaN if the file does not contain it."""
        return np.array(self.sigma_position_mm or [np.nan] * 3, dtype=np.float64) * MILLIMETRE

    @property
    def sigma_rotation(self) -> Floats:
        """Standard deviation of the rotation, (3,) [rad]; NaN if the file does not contain it."""
        return np.array(self.sigma_rotation_arcsec or [np.nan] * 3, dtype=np.float64) * ARCSECOND


class AxesEntry(Entry):
    """Standard deviations of a frame that declared target coordinates define, from residuals of these coordinates."""

    target_names: tuple[str, ...]
    """Names of the targets whose coordinates define the frame."""
    sigma_position_mm: Vector
    """Standard deviation of the frame's translation along x, y and z [mm], at the centroid of the targets that
    define it."""
    sigma_rotation_arcsec: Vector
    """Standard deviation of the rotation of the frame about x, y and z [arcsec]; 0 for rotations fixed by levels."""


class OutlierRow(Entry):
    """Outlying reading, or the reading with the largest residual of a pointing that was excluded as a whole."""

    row: int
    """Row number of the pointing in `observations.csv`, from 1."""
    station: str
    """Name of the station."""
    target: str
    """Name of the target."""
    observable: str
    """Observable: `distance`, `azimuth` or `elevation`."""
    size: Finite
    """Estimated gross error of the reading, in `unit`."""
    unit: str
    """Unit of `size`."""
    w: Finite
    """Normalised residual (statistic of the w-test)."""
    p_value: OptionalFloat = None
    """p-value of the w-test, or of the tau-test if the noise is estimated, corrected for the number of readings. Null
    for excluded readings."""
    pointing_excluded: bool = False
    """True if the whole pointing was excluded; the entry then shows its reading with the largest residual."""
    excluded: bool = False
    """True if the reading was excluded from the adjustment."""


class ReferenceValueTestEntry(Entry):
    """Component of a reference value (coordinate, length, level), tested against all other observations like a reading.

    Coordinates that define only the axes have the kind `axes`.
    """

    kind: Literal["point", "difference", "length", "level", "yaw", "mark", "axes", "scale"]
    """Kind of reference value, such as `point` or `length`."""
    name: str
    """Name of the target or station, of both ends of a length or difference, or of the observations whose scale is
    tested."""
    component: str = ""
    """Component x, y or z of a point or difference; x and y for the two tilts of a level."""
    residual: Finite
    """Declared minus adjusted value, in `unit`."""
    error: Finite
    """Error of the declared value, estimated from all other observations, in `unit`."""
    sigma_error: OptionalFloat = None
    """Standard deviation of the estimated error; null without redundancy."""
    minimal_detectable_error: OptionalFloat = None
    """Smallest error that the test detects with probability 80 %."""
    unit: str
    """Unit of `residual`, `error`, `sigma_error` and `minimal_detectable_error`."""
    redundancy: Finite
    """Redundancy number: fraction of an error of the declared value that appears in its residual."""
    w: Finite
    """Statistic of the w-test of this component: absolute value of `error` divided by `sigma_error`; 0 if untested."""
    excluded: bool = False
    """True if the value contradicts all other observations and was excluded from the adjustment."""


class NoiseRow(Entry):
    """Noise of a group of readings, estimated from their residuals.

    If `factor_sigma` is null, the redundancy was too small for an estimate, and the factor is 1.
    """

    observable: str
    """Observable: `distance`, `azimuth`, `elevation` or `level`."""
    instrument: str = ""
    """Name of the instrument; empty if all instruments are one group."""
    factor: Finite
    """Ratio of the estimated to the declared standard deviations of the readings."""
    factor_sigma: OptionalFloat = None
    """Standard deviation of the factor."""
    redundancy: Finite
    """Sum of the redundancy numbers of the readings of the group."""
    median_sigma: Finite
    """Median of the estimated standard deviations of the readings."""
    unit: str = ""
    """Unit of `median_sigma`."""


class VerdictEntry(Entry):
    """Verdict on the test to trust (global test or estimated sigma0), if the tests of a fit disagree."""

    case: str = ""
    """Short text on the agreement or disagreement of the tests."""
    sentence: str = ""
    """Sentence for users with the verdict."""
    is_sigma0_credible: bool = False
    """True if the estimated sigma0 is more credible than the declared noise."""

    @classmethod
    def from_verdict(cls, verdict: Verdict) -> Self:
        """Entry of the result file for the verdict on an adjustment."""
        return cls(case=verdict.case.value, sentence=verdict.sentence, is_sigma0_credible=verdict.uses_estimated_noise)


class RecommendedCorrection(Entry):
    """Recommended correction of readings, and expected error of new points with and without this correction."""

    prior_scale: Positive
    """Most likely size of the parameters relative to their prior standard deviations."""
    prior_scale_limits: tuple[Positive, Positive]
    """Lower and upper limit of `prior_scale`, each with a one-sided confidence of 95 %."""
    uncorrected_error_um: NotNegative
    """Expected rms error [um] of an uncorrected point in the frame of its set-up, due to errors of the instrument
    constants only."""
    corrected_error_um: NotNegative
    """Expected rms error [um] of a corrected point in the frame of its set-up, due to errors of the instrument
    constants only."""
    noise_error_um: NotNegative = 0.0
    """Expected rms 3D error [um] of a new point due to the noise of its readings."""
    unapplied_parameters: tuple[str, ...] = ()
    """Names of the parameters that are not applied, because held-out targets are predicted better without them."""
    sentences: tuple[str, ...] = ()
    """Sentences for users on the correction."""

    @property
    def uncorrected_and_corrected_point_error_um(self) -> tuple[float, float]:
        """Expected 3D error [um] of a new point without and with correction, including the noise of its readings."""
        noise = self.noise_error_um
        return math.hypot(self.uncorrected_error_um, noise), math.hypot(self.corrected_error_um, noise)

    @property
    def point_error_text(self) -> str:
        """Text for users with the expected error of a new point without and with correction."""
        before, after = (number_text(error, 3) for error in self.uncorrected_and_corrected_point_error_um)
        noise = f"{number_text(self.noise_error_um, 3)} um of it is the measurement noise of that point"
        return f"expected 3D error of a new point: {before} um uncorrected, {after} um corrected ({noise})"


class FittedParameterEntry(Entry):
    """Value that describes an estimated effect: a parameter, shape parameter, or size of an empirical law."""

    name: str
    """Name of the parameter as in `ltsim effects`; for an empirical law the name of a size, such as `amplitude` or
    `phase`."""
    value: Finite | str
    """Value in `unit`; a text for a shape parameter whose values are names."""
    sigma: Sigma = None
    """Standard deviation of the value; null for a fixed shape parameter."""
    unit: str
    """Unit of value and standard deviation."""


class FittedEffectEntry(Entry):
    """Effect or empirical law (a function such as `elevation ~ time`) that was estimated at the request of the user."""

    effect: str
    """Name of the effect as in `ltsim effects`; for an empirical law its text, such as `elevation ~ time`."""
    place_text: str = ""
    """Stations and targets where the effect acts; empty for all."""
    parameters: tuple[FittedParameterEntry, ...] = ()
    """Parameters and shape parameters of the effect."""
    chi2_drop: NotNegative
    """Decrease of chi-square by the effect."""
    n_distinguishable_parameters: int
    """Number of the effect's parameters that the recording distinguishes from all other unknowns."""
    n_candidates: int
    """Number of tested combinations of stations, targets and shape parameters, from which the reported one was
    selected."""

    @property
    def p_value(self) -> float:
        """Probability of a decrease of at least `chi2_drop` without the effect, corrected for `n_candidates`."""
        return (
            min(1.0, self.n_candidates * float(special.chdtrc(self.n_distinguishable_parameters, self.chi2_drop)))
            if self.n_distinguishable_parameters
            else 1.0
        )

    @property
    def sentence(self) -> str:
        """Sentence for users with the estimated size of the effect and its significance."""
        name = self.effect + (f" at {self.place_text}" if self.place_text else "")
        if not self.n_distinguishable_parameters:
            return f"{name}: not estimated, because the readings do not separate it from poses, targets and parameters"
        phrase = ", ".join(
            f"{p.name} {p.value}" if isinstance(p.value, str) else f"{p.name} {with_sigma(p.value, p.sigma, p.unit)}"
            for p in self.parameters
        )
        candidates_text = f", selected from {self.n_candidates} candidates" if self.n_candidates > 1 else ""
        p_value_text = p_value_relation_text(self.p_value)
        return f"{name}: {phrase}; chi-square falls by {self.chi2_drop:.1f} ({p_value_text}{candidates_text})"


class ReflectorEntry(Entry):
    """Incidence error (range error by angle of incidence) of a reflector in fixed nests, estimated with the network."""

    reflector: str = ""
    """Name of the reflector; empty if the recording contains no names of reflectors."""
    parameters: tuple[FittedParameterEntry, ...]
    """Parameters of the reflector's incidence error, as in the effect `smr-incidence`."""


PARAMETERS_TABLE = Table(
    "parameters.csv",
    "estimates of the instrument's parameters, each in its unit",
    model_columns(
        ParameterEntry,
        "name instrument value sigma unit prior_sigma held applied_value",
        value={"sigma_column": "sigma"},
        prior_sigma={"display_format": ".3g"},
        name={"name": "parameter"},
    ),
)
REFERENCE_VALUES_TABLE = Table(
    "reference_values.csv",
    "reference values, each tested by the other observations",
    model_columns(ReferenceValueTestEntry),
)
OUTLIERS_TABLE = Table("outliers.csv", "outlying readings", model_columns(OutlierRow))
NOISE_TABLE = Table(
    "noise.csv",
    "noise estimated from the readings",
    model_columns(
        NoiseRow,
        factor={"sigma_column": "factor_sigma"},
        redundancy={"display_format": ".1f"},
        median_sigma={"display_format": ".3g"},
    ),
)
REFLECTOR_INCIDENCE_TABLE = Table(
    "reflectors.csv",
    "incidence errors of reflectors in fixed nests, parameters of smr-incidence",
    (
        *text_columns(reflector="name of the SMR, or empty", parameter="as `ltsim effects` lists it"),
        *number_columns(".2f", value_um="estimate", sigma_um="standard deviation"),
    ),
)
STATION_COORDINATES_TABLE = Table(
    "places.csv",
    "coordinates and expanded uncertainties",
    (
        *text_columns(name="of the target or station"),
        *number_columns(display_format=".4f", x_mm="coordinate", y_mm="coordinate", z_mm="coordinate"),
        *(Column(f"U_{axis}_um", "expanded uncertainty, k = 2", n_digits=2) for axis in "xyz"),
    ),
)
STATIONS_TABLE = Table(
    "stations.csv", "adjusted stations", (Column("station", "name", "text"), *COORDINATE_COLUMNS[1:])
)
