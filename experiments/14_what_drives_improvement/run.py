"""Sobol indices of the errors that determine how much a calibration improves the paper's criteria.

The sizes of all groups of errors are uncertain over a range, evenly in their logarithm; a first-order index is the
share of the variance of a criterion that knowing one size would remove, a total index the share that would remain if
all others were known (Saltelli et al., Comput. Phys. Commun. 181 (2010) 259-270, by `scipy.stats.sobol_indices`).
"""

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from experiments.common import Made, Options, Row, show_table, write_table
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
"""Attribute of the expected criteria by the name of an output."""
Ranges = Mapping[str, tuple[float, float]]
"""Lowest and highest size of each uncertain group of errors, in units of its stated size."""


def sensitivity(predictor: DisagreementPredictor, ranges: Ranges, samples: int, seed: int) -> list[Row]:
    """First-order and total index of each output by each input, with 95 % intervals (bootstrap)."""
    names, logs = list(ranges), np.log(list(ranges.values()))

    def criteria(sizes: Floats) -> Floats:
        expected = predictor.expected_disagreement(dict(zip(names, np.exp(sizes), strict=True)))
        return np.stack([getattr(expected, attribute) for attribute in OUTPUTS.values()])

    dists = [stats.uniform(loc=low, scale=high - low) for low, high in logs]
    indices = stats.sobol_indices(func=criteria, n=samples, dists=dists, random_state=random_stream(seed, "sobol"))
    # An output that an input does not move has no bootstrap distribution; its interval is the index itself.
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        spread = indices.bootstrap(0.95)
    columns = {}
    for name, index, interval in (
        ("first", indices.first_order, spread.first_order), ("total", indices.total_order, spread.total_order),
    ):  # fmt: skip
        ends = interval.confidence_interval
        columns |= {name: index, f"{name}_low": ends.low, f"{name}_high": ends.high}
        columns |= {
            k: np.where(np.isfinite(values), values, index) for k, values in columns.items() if k.startswith(name)
        }
    return [
        {"output": output, "input": name} | {key: float(values[i, j]) for key, values in columns.items()}
        for i, output in enumerate(OUTPUTS)
        for j, name in enumerate(names)
    ]


def effects_of(names: Sequence[str], stations: Sequence[str]) -> list[Effect]:
    """The effects that calibration does not know; one of a single station acts on all, each with its own size."""
    effects: list[Effect] = []
    for name in names:
        kind = find_effect(name)
        effects += [kind(stations=(s,)) for s in stations] if kind.scope == "station" else [kind()]
    return effects


def improvement_rows(predictor: DisagreementPredictor, ranges: Ranges, seed: int) -> list[Row]:
    """Both improvements over 2,000 draws of the sizes, and what is left afterwards."""
    rng = np.random.default_rng(seed)
    sizes = {g: np.exp(rng.uniform(np.log(low), np.log(high), 2000)) for g, (low, high) in ranges.items()}
    expected, rows = predictor.expected_disagreement(sizes), []
    for kind in ("distance", "coordinate"):
        gains = np.percentile(getattr(expected, f"{kind}_improvement"), [5, 50, 95])
        named = dict(zip(("improvement_p5", "improvement_median", "improvement_p95"), gains, strict=True))
        expected_median = np.median(getattr(expected, f"{kind}_disagreement_after") / MICROMETRE)
        rows.append({"criterion": kind} | named | {"after_median_um": expected_median})
    return rows


def run(given: Options) -> Made:
    """Predict, then take the predictions apart."""
    config, indices, spread = given.config, [], []
    samples, seed = given.trials or config["samples"], config["seed"]
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
    write_table(given.out / "indices.csv", indices)
    show_table(given.out / "improvement.csv", spread)
    return Made(seed, samples)
