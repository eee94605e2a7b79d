"""Sobol indices of the errors that determine how much a calibration improves the paper's criteria.

The size of each group of errors is uncertain, log-uniform over a range. A first-order index is the fraction of the
variance of a criterion that vanishes if one size is known; a total index is the fraction that remains if all other
sizes are known (Saltelli et al., Comput. Phys. Commun. 181 (2010) 259-270, by `scipy.stats.sobol_indices`).
"""

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from experiments.common import Options, Row, RunRecord, show_table, write_table
from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.effect import Effect
from ltsim.planning.expected_precision import DisagreementPredictor, ExpectedPrecision
from ltsim.planning.search_inputs import planned_survey
from ltsim.simulation.scenario import load_scenario

OUTPUTS = {
    "distance improvement": "distance_improvement",
    "coordinate improvement": "coordinate_improvement",
    "distance after": "distance_disagreement_after",
    "coordinate after": "coordinate_disagreement_after",
}
"""Attribute of the expected criteria for each output, by name of the output."""
Ranges = Mapping[str, tuple[float, float]]
"""Smallest and largest size of each uncertain group of errors, relative to its declared size."""


def sensitivity(predictor: DisagreementPredictor, ranges: Ranges, samples: int, seed: int) -> list[Row]:
    """First-order and total index of each output for each input, with 95 % intervals (bootstrap)."""
    names, logs = list(ranges), np.log(list(ranges.values()))

    def criteria(sizes: Floats) -> Floats:
        expected = predictor.expected_disagreement(dict(zip(names, np.exp(sizes), strict=True)))
        return np.stack([getattr(expected, attribute) for attribute in OUTPUTS.values()])

    dists = [stats.uniform(loc=low, scale=high - low) for low, high in logs]
    evaluations: dict[str, Floats] = {}

    def indices_of(f_A: np.ndarray, f_B: np.ndarray, f_AB: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # noqa: N803
        evaluations.update(f_A=f_A, f_B=f_B, f_AB=f_AB)
        first, total = sobol_indices(f_A, f_B, f_AB)
        return first, total

    stats.sobol_indices(
        func=criteria, n=samples, dists=dists, method=indices_of, random_state=random_stream(seed, "sobol")
    )
    indices = sobol_indices(**evaluations)
    # If an input does not affect an output, the bootstrap distribution is degenerate; the interval is then the index.
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        ends = stats.bootstrap(
            [np.arange(samples)],
            lambda trials: sobol_indices(**{name: values[..., trials] for name, values in evaluations.items()}),
            n_resamples=999,
            rng=random_stream(seed, "bootstrap"),
        ).confidence_interval
    columns = {}
    for k, name in enumerate(("first", "total")):
        columns[name] = indices[k]
        for end, values in (("low", ends.low), ("high", ends.high)):
            columns[f"{name}_{end}"] = np.where(np.isfinite(values[k]), values[k], indices[k])
    return [
        {"output": output, "input": name} | {key: float(values[i, j]) for key, values in columns.items()}
        for i, output in enumerate(OUTPUTS)
        for j, name in enumerate(names)
    ]


def sobol_indices(f_A: Floats, f_B: Floats, f_AB: Floats) -> Floats:  # noqa: N803 (names of scipy)
    """First-order and total indices (2, s, d) of s outputs for d inputs, by equations (b) and (f) of Saltelli et al.

    `f_A`, `f_B` (s, n) are the outputs, minus their means, for two samples of n inputs; `f_AB` (d, s, n) those for the
    first sample with one input from the second. An output without variance has indices 0.
    """
    variance = np.var(np.concatenate([f_A, f_B], axis=-1), axis=-1)
    covariance = np.mean(f_B * (f_AB - f_A), axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        indices = np.stack([covariance, 0.5 * np.mean((f_A - f_AB) ** 2, axis=-1)]) / variance
    return np.nan_to_num(np.swapaxes(indices, -1, -2), posinf=0.0, neginf=0.0)


def effects_of(names: Sequence[str], stations: Sequence[str]) -> list[Effect]:
    """Effects that the calibration does not model.

    An effect of one station is created for each station, with a separate size.
    """
    effects: list[Effect] = []
    for name in names:
        kind = find_effect(name)
        effects += [kind(stations=(s,)) for s in stations] if kind.scope == "station" else [kind()]
    return effects


def improvement_rows(predictor: DisagreementPredictor, ranges: Ranges, seed: int) -> list[Row]:
    """Quantiles of both improvements over 2,000 draws of the sizes, and the median criterion after calibration."""
    rng = np.random.default_rng(seed)
    sizes = {g: np.exp(rng.uniform(np.log(low), np.log(high), 2000)) for g, (low, high) in ranges.items()}
    expected, rows = predictor.expected_disagreement(sizes), []
    for kind in ("distance", "coordinate"):
        gains = np.percentile(getattr(expected, f"{kind}_improvement"), [5, 50, 95])
        quantiles = dict(zip(("improvement_p5", "improvement_median", "improvement_p95"), gains, strict=True))
        expected_median = np.median(getattr(expected, f"{kind}_disagreement_after") / MICROMETRE)
        rows.append({"criterion": kind} | quantiles | {"after_median_um": expected_median})
    return rows


def run(options: Options) -> RunRecord:
    """Predict the improvements, and decompose their variance."""
    config, indices, spread = options.config, [], []
    samples, seed = options.trials or config["samples"], config["seed"]
    for name in config["scenarios"]:
        survey = planned_survey(load_scenario(name))
        effects = effects_of(config["left_out"], survey.station_names)
        predictor, excluded = (
            DisagreementPredictor.from_expected_precision(ExpectedPrecision.from_survey(survey), effects),
            {effect.name for effect in effects},
        )
        ranges = {g: tuple(config["range_left_out" if g in excluded else "range"]) for g in predictor.error_groups}
        spread += [{"scenario": name} | row for row in improvement_rows(predictor, ranges, seed)]
        indices += [{"scenario": name} | row for row in sensitivity(predictor, ranges, samples, seed)]
    write_table(options.out / "indices.csv", indices)
    show_table(options.out / "improvement.csv", spread)
    return RunRecord(seed, samples)
