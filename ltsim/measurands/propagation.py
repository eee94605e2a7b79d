"""Uncertainty of results by first-order propagation (JCGM 100, 102) and by Monte Carlo (JCGM 101, clauses 7, 8).

In the Monte Carlo simulation each source of uncertainty is drawn from its distribution with a separate random stream,
the points are displaced accordingly, and the tasks are evaluated exactly. The linearised tasks are evaluated with the
same draws. The distribution of the linearised results is known exactly, because they are sums of independent variables.
The simulation therefore only estimates the difference between exact and linearised results (control variate). This
needs few trials for a nearly linear task and none for a linear one.

Batches of trials are added until the numerical error is a fifth of the numerical tolerance, as clause 8.2 requires for
the comparison with the interval by propagation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import optimize, special

from ltsim.adjustment import adjust
from ltsim.core.arrays import Bools, Floats, batches
from ltsim.core.equality import ValueEquality
from ltsim.core.limits import MAX_UNCERTAINTY_TRIALS_TIMES_RESULTS
from ltsim.core.randomness import random_stream
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.geometry.expansion import ThermalExpansion
from ltsim.measurands.inputs import RANDOM_STREAM_KEY_BY_SOURCE, TaskInputs
from ltsim.measurands.measurands import Measurand
from ltsim.measurands.spec import MonteCarloSettings, PartExpansion
from ltsim.recordings.epoch_coordinates import EpochCoordinates

N_NONLINEARITY_DRAWS = 8
"""Number of random draws of errors with which the exact and the linearised adjustment are compared."""
MAX_NONLINEARITY_RATIO = 0.05
"""Limit of the difference of a result between the exact and the linearised adjustment, divided by its standard
uncertainty. A larger difference leads to a warning."""


def thermal_expansion_of_part(declared_expansion: PartExpansion | None) -> ThermalExpansion:
    """Thermal expansion of a part from the reference temperature to its temperature in the measurement.

    The expansion is zero if the task file declares none.
    """
    if declared_expansion is None:
        return ThermalExpansion()
    kelvin = declared_expansion.measured_c - declared_expansion.reference_c
    return ThermalExpansion.from_temperature_difference(
        declared_expansion.expansion_per_k,
        kelvin,
        declared_expansion.sigma_expansion_per_k,
        declared_expansion.sigma_temperature_k,
    )


def length_ratio_sigmas(thermal_expansion: ThermalExpansion) -> list[tuple[str, float]]:
    """Name of each error of a part's thermal expansion, and standard deviation of the length ratio from this error.

    The length ratio is the length of the part in the measurement divided by its length at the reference temperature.
    """
    error_sizes = [
        ("expansion of the part", thermal_expansion.ratio_change_per_coefficient_sigma),
        ("temperature of the part", thermal_expansion.ratio_change_per_temperature_sigma),
    ]
    return [(name, change) for name, change in error_sizes if change]


@dataclass(frozen=True)
class LinearUncertainty(ValueEquality):
    """Results of all tasks, with their uncertainty by the law of propagation (GUM)."""

    result_values: Floats
    """Results of all tasks in their order, shape (results,) [SI]."""
    covariance: Floats
    """Covariance of the results, shape (results, results) [SI]."""
    variance_by_source: dict[str, Floats]
    """Variance (results,) [SI] of each result from each source of uncertainty, by name of the source. The sum over the
    sources is the total variance."""
    evaluation_types: dict[str, Literal["A", "B"]]
    """Type of evaluation (GUM) of each source of uncertainty, ``A`` or ``B``, by name of the source."""
    point_derivatives: Floats
    """Derivatives (results, coordinates) [SI] of the results by the coordinates of the points."""
    length_ratio_derivatives: Floats
    """Derivatives (results,) [SI] of the results by the length ratio of the part (length in the measurement divided by
    length at the reference temperature)."""

    @property
    def standard_uncertainties(self) -> Floats:
        """Standard uncertainty of each result, shape (results,) [SI]."""
        return np.sqrt(np.diag(self.covariance))

    def expanded_uncertainty(self, coverage_probability: float) -> Floats:
        """Expanded uncertainty (results,) [SI] for a coverage probability, for normally distributed results."""
        return float(special.ndtri(0.5 + coverage_probability / 2)) * self.standard_uncertainties

    @property
    def correlation(self) -> Floats:
        """Correlation matrix of the results, shape (results, results); NaN for a result without uncertainty."""
        with np.errstate(invalid="ignore", divide="ignore"):
            correlation: Floats = self.covariance / np.outer(self.standard_uncertainties, self.standard_uncertainties)
        return correlation


def propagate(
    task_inputs: TaskInputs, measurands: Sequence[Measurand], thermal_expansion: ThermalExpansion
) -> LinearUncertainty:
    """Results of all tasks, with uncertainty by first-order propagation through adjustment and tasks."""
    points = task_inputs.points
    result_values = np.concatenate([m.values(points, thermal_expansion.length_ratio) for m in measurands])
    by_points = np.concatenate([m.point_derivatives(points, thermal_expansion.length_ratio) for m in measurands])
    by_stretch = np.concatenate(
        [m.length_ratio_derivatives(points, thermal_expansion.length_ratio) for m in measurands]
    )
    covariance = np.zeros((len(result_values), len(result_values)))
    shares: dict[str, Floats] = {}
    kinds: dict[str, Literal["A", "B"]] = {}
    for source in task_inputs.sources:
        reached = by_points @ source.displacements_per_sigma
        covariance += reached @ reached.T
        shares[source.name] = shares.get(source.name, 0.0) + np.sum(reached**2, axis=1)
        kinds[source.name] = source.evaluation_type
    for name, sigma in length_ratio_sigmas(thermal_expansion):
        reached = by_stretch * sigma
        covariance += np.outer(reached, reached)
        shares[name] = reached**2
        kinds[name] = "B"
    return LinearUncertainty(result_values, covariance, shares, kinds, by_points, by_stretch)


def max_nonlinearity_differences(task_inputs: TaskInputs, measurands: Sequence[Measurand], seed: int) -> Floats:
    """Largest difference (results,) [SI] of each result between the exact and the linearised adjustment.

    The recording is adjusted again with a few draws of noise from `seed`. The difference is zero for a list of
    coordinates, which has no readings.
    """
    network_or_coordinates = task_inputs.network_or_coordinates
    if isinstance(network_or_coordinates, EpochCoordinates):
        return np.zeros(sum(len(m.outputs) for m in measurands))
    recording, problem = network_or_coordinates.recording, network_or_coordinates.problem
    indices = [recording.targets.index(name) for name in task_inputs.target_names]
    used, count = problem.is_used_reading, int(problem.is_used_reading.sum())
    largest_differences = np.zeros(sum(len(m.outputs) for m in measurands))
    for i in range(N_NONLINEARITY_DRAWS):
        noise = random_stream(seed, "curvature", i).standard_normal(count)
        readings = recording.readings.copy()
        readings[used] += noise * problem.reading_sigmas[used]
        again = adjust(
            recording.with_readings(readings),
            network_or_coordinates.construction,
            effects=network_or_coordinates.effects,
            sigma=problem.reading_sigmas,
            reading_mask=problem.is_used_reading,
            start_state=network_or_coordinates.state,
            datum_names=network_or_coordinates.datum.point_names if network_or_coordinates.datum is not None else None,
        )
        shift = (noise @ task_inputs.displacement_per_observation[:count]).reshape(-1, 3)
        linear = np.concatenate([m.values(task_inputs.points + shift) for m in measurands])
        exact = np.concatenate([m.values(again.state.target_points[indices]) for m in measurands])
        largest_differences = np.maximum(largest_differences, np.abs(exact - linear))
    return largest_differences


TRIALS_PER_BATCH = 10_000
"""Number of trials in a batch; the stability of the results is checked after each batch."""
MIN_NUMERICAL_TOLERANCE_TO_ERROR_RATIO = 5.0
"""Limit of the ratio of the numerical tolerance of a result to its numerical error. The intervals by propagation and
Monte Carlo are compared only if the ratio is larger (JCGM 101, clause 8.2)."""
CHARACTERISTIC_FUNCTION_STEP = 0.05
"""Step of the numerical integral over the characteristic function of a result, in units of 1 / (standard deviation of
the result)."""
N_CHARACTERISTIC_FUNCTION_STEPS = 40_000
"""Number of steps of the numerical integral over the characteristic function of a result."""
CHARACTERISTIC_FUNCTIONS: dict[str, Callable[[Floats], Floats]] = {
    "rectangular": lambda t: np.sinc(np.sqrt(3.0) * t / np.pi),
    "triangular": lambda t: np.sinc(np.sqrt(1.5) * t / np.pi) ** 2,
    "arcsine": lambda t: special.j0(np.sqrt(2.0) * t),
}
"""Characteristic function of each distribution, scaled to mean 0 and standard deviation 1, by name of the
distribution."""


@dataclass(frozen=True)
class MonteCarloUncertainty(ValueEquality):
    """Distribution of each result by Monte Carlo simulation, in SI units."""

    trial_results: Floats
    """Results [SI] of all trials, shape (trials, results)."""
    means: Floats
    """Mean of each result over the trials, shape (results,)."""
    standard_uncertainties: Floats
    """Standard deviation of each result over the trials, shape (results,)."""
    symmetric_intervals: Floats
    """Limits of the probabilistically symmetric coverage interval of each result, shape (results, 2)."""
    shortest_intervals: Floats
    """Limits of the shortest coverage interval of each result, shape (results, 2)."""
    numerical_errors: Floats
    """Numerical error (results,) of the limits of each symmetric interval: two standard deviations, since the number of
    trials is finite."""
    is_stable: Bools
    """Mask (results,): True for a result that is stable to the requested number of digits."""
    numerical_tolerances: Floats
    """Numerical tolerance of each result, shape (results,): half a unit in the last requested digit of its standard
    uncertainty (JCGM 101, clause 7.9.2)."""

    @property
    def n_trials(self) -> int:
        """Number of Monte Carlo trials."""
        return len(self.trial_results)

    def intervals_agree(self, linear_uncertainty: LinearUncertainty, coverage_probability: float) -> Bools:
        """Mask (results,): True if a result's intervals by propagation and by Monte Carlo agree (JCGM 101, clause 8).

        The limits may differ by the numerical tolerance plus the numerical error, which is at most a fifth of the
        tolerance for stable results.
        """
        expanded = linear_uncertainty.expanded_uncertainty(coverage_probability)
        limits = np.stack(
            [linear_uncertainty.result_values - expanded, linear_uncertainty.result_values + expanded], axis=1
        )
        allowed = self.numerical_tolerances + self.numerical_errors
        return np.all(np.abs(limits - self.symmetric_intervals) <= allowed[:, None], axis=1)


def run_monte_carlo(
    task_inputs: TaskInputs,
    measurands: Sequence[Measurand],
    thermal_expansion: ThermalExpansion,
    monte_carlo_settings: MonteCarloSettings,
    linear_uncertainty: LinearUncertainty,
) -> MonteCarloUncertainty:
    """Distribution of the results of all tasks by Monte Carlo trials.

    Trials are added until the numerical error of each result is a fifth of its numerical tolerance, or until the
    largest number of trials in `monte_carlo_settings` is reached. `linear_uncertainty` is the result of `propagate`.
    """
    exact = _linear_statistics(task_inputs, linear_uncertainty, monte_carlo_settings.coverage_probability)
    samples: list[Floats] = []
    figures: list[Floats] = []
    max_trials = min(
        monte_carlo_settings.max_trials, MAX_UNCERTAINTY_TRIALS_TIMES_RESULTS // len(linear_uncertainty.result_values)
    )
    max_batches = max(max_trials // TRIALS_PER_BATCH, 1)
    uncertain = (
        linear_uncertainty.standard_uncertainties > 0
    )  # half a unit in the last digit of each standard uncertainty (JCGM 101, clause 7.9.2)
    power = np.floor(np.log10(np.where(uncertain, linear_uncertainty.standard_uncertainties, 1.0))) - (
        monte_carlo_settings.digits - 1
    )
    tolerance = np.where(uncertain, 0.5 * 10.0**power, 0.0)
    error = np.full((4, len(linear_uncertainty.result_values)), np.inf)
    while len(samples) < max_batches and not np.all(MIN_NUMERICAL_TOLERANCE_TO_ERROR_RATIO * error <= tolerance):
        shift, grown = _draw_errors(task_inputs, thermal_expansion, monte_carlo_settings.seed, len(samples))
        by_line = (
            linear_uncertainty.result_values
            + shift @ linear_uncertainty.point_derivatives.T
            + np.outer(grown, linear_uncertainty.length_ratio_derivatives)
        )
        points = task_inputs.points + shift.reshape(TRIALS_PER_BATCH, *task_inputs.points.shape)
        samples.append(_evaluate_results(measurands, points, thermal_expansion.length_ratio + grown))
        figures.append(
            _batch_statistics(samples[-1], monte_carlo_settings.coverage_probability)
            - _batch_statistics(by_line, monte_carlo_settings.coverage_probability)
        )
        if len(samples) > 1:
            error = 2.0 * np.std(figures, axis=0, ddof=1) / np.sqrt(len(figures))
    mean, sigma, low, high = exact + np.mean(figures, axis=0)
    all_results = np.concatenate(samples)
    return MonteCarloUncertainty(
        trial_results=all_results,
        means=mean,
        standard_uncertainties=sigma,
        symmetric_intervals=np.stack([low, high], axis=1),
        shortest_intervals=shortest_intervals(all_results, monte_carlo_settings.coverage_probability),
        numerical_errors=error[2:].max(axis=0),
        is_stable=np.all(error <= tolerance, axis=0),
        numerical_tolerances=tolerance,
    )


def _draw_errors(
    task_inputs: TaskInputs, thermal_expansion: ThermalExpansion, seed: int, batch_number: int
) -> tuple[Floats, Floats]:
    """Random errors of one batch: of the coordinates (trials, coordinates) [m], and of the length ratio (trials,).

    `batch_number` and `seed` determine the draws.
    """
    shift = np.zeros((TRIALS_PER_BATCH, task_inputs.points.size))
    for i, source in enumerate(task_inputs.sources):
        shape = TRIALS_PER_BATCH, source.displacements_per_sigma.shape[1]
        key = RANDOM_STREAM_KEY_BY_SOURCE.get(source.name, source.name)
        rng = random_stream(seed, "uncertainty", key, i, batch_number)
        shift += draw_variates(rng, source.distribution, shape) @ source.displacements_per_sigma.T
    grown = np.zeros(TRIALS_PER_BATCH)
    for name, sigma in length_ratio_sigmas(thermal_expansion):
        grown += sigma * random_stream(seed, "uncertainty", name, batch_number).standard_normal(TRIALS_PER_BATCH)
    return shift, grown


def _evaluate_results(measurands: Sequence[Measurand], points: Floats, length_ratio: Floats) -> Floats:
    """Results (trials, results) [SI] of all tasks for the displaced points (trials, points, 3) [m] of each trial.

    `length_ratio` (trials,) is the length of the part in the measurement divided by its length at the reference
    temperature.
    """
    pieces = list(batches(len(points), points[0].size))
    result_rows = [np.concatenate([m.values(points[p], length_ratio[p]) for m in measurands], axis=1) for p in pieces]
    return np.concatenate(result_rows)


def _linear_statistics(
    task_inputs: TaskInputs, linear_uncertainty: LinearUncertainty, coverage_probability: float
) -> Floats:
    """Mean, standard deviation and two interval limits of each linearised result, shape (4, results) [SI].

    They are computed from the exact distribution of the linearised results, without random draws.
    """
    others = [
        (s.distribution, linear_uncertainty.point_derivatives @ s.displacements_per_sigma)
        for s in task_inputs.sources
        if s.distribution != "normal"
    ]
    half_widths = np.array(
        [
            _coverage_half_width(float(sigma), [(name, sizes[i]) for name, sizes in others], coverage_probability)
            for i, sigma in enumerate(linear_uncertainty.standard_uncertainties)
        ]
    )
    return np.stack(
        [
            linear_uncertainty.result_values,
            linear_uncertainty.standard_uncertainties,
            linear_uncertainty.result_values - half_widths,
            linear_uncertainty.result_values + half_widths,
        ]
    )


def _coverage_half_width(
    total_sigma: float, other_distributions: Sequence[tuple[str, Floats]], coverage_probability: float
) -> float:
    """Half-width of the coverage interval of a sum of independent symmetric random variables.

    `total_sigma` is the standard deviation of the sum. `other_distributions` holds the name of each distribution that
    is not normal, and the standard deviations of the variables with this distribution. The remaining variance is
    normal. The characteristic function of the sum, a product, is inverted (Gil-Pelaez, Biometrika 38 (1951) 481).
    """
    independent = sum(float(np.sum(sizes**2)) for _, sizes in other_distributions)
    if total_sigma == 0 or independent <= SQRT_MACHINE_EPSILON * total_sigma**2:
        return float(special.ndtri(0.5 + coverage_probability / 2)) * total_sigma
    frequencies = CHARACTERISTIC_FUNCTION_STEP * (np.arange(N_CHARACTERISTIC_FUNCTION_STEPS) + 0.5)
    damping = np.exp(-0.5 * max(1.0 - independent / total_sigma**2, 0.0) * frequencies**2)
    for name, sizes in other_distributions:
        for size in np.abs(sizes[sizes != 0]) / total_sigma:
            damping = damping * CHARACTERISTIC_FUNCTIONS[name](size * frequencies)

    def excess(width: float) -> float:
        return (
            float(
                2.0 / np.pi * CHARACTERISTIC_FUNCTION_STEP * np.sum(np.sin(width * frequencies) / frequencies * damping)
            )
            - coverage_probability
        )

    return total_sigma * float(optimize.brentq(excess, 1e-3, 20.0, xtol=1e-6))


def draw_variates(
    random_generator: np.random.Generator, distribution_name: str, array_shape: tuple[int, ...]
) -> Floats:
    """Random draws with mean 0 and variance 1 from the distribution with this name, in an array of `array_shape`."""
    if distribution_name == "rectangular":
        return random_generator.uniform(-np.sqrt(3.0), np.sqrt(3.0), array_shape)
    if distribution_name == "triangular":
        return random_generator.triangular(-np.sqrt(6.0), 0.0, np.sqrt(6.0), array_shape)
    if distribution_name == "arcsine":
        return np.sqrt(2.0) * np.sin(random_generator.uniform(-np.pi, np.pi, array_shape))
    return random_generator.standard_normal(array_shape)


def _batch_statistics(trial_results: Floats, coverage_probability: float) -> Floats:
    """Mean, standard deviation and two limits of the symmetric interval of each result in a batch, (4, results) [SI].

    `trial_results` has the shape (trials, results).
    """
    tail = 50.0 * (1.0 - coverage_probability)
    limits = np.percentile(trial_results, [tail, 100.0 - tail], axis=0)
    return np.stack([trial_results.mean(axis=0), trial_results.std(axis=0, ddof=1), *limits])


def shortest_intervals(trial_results: Floats, coverage_probability: float) -> Floats:
    """Limits (results, 2) of the shortest coverage interval of each result (JCGM 101, clause 7.7).

    `trial_results` has the shape (trials, results).
    """
    ordered = np.sort(trial_results, axis=0)
    n_samples = len(ordered)
    n_inside = int(np.clip(round(coverage_probability * n_samples), 1, n_samples - 1))
    best_index = np.argmin(ordered[n_inside:] - ordered[: n_samples - n_inside], axis=0)
    columns = np.arange(trial_results.shape[1])
    return np.stack([ordered[best_index, columns], ordered[best_index + n_inside, columns]], axis=1)
