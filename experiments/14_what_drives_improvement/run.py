"""Which errors decide how much calibration improves the paper's criteria? Sobol indices."""

from collections.abc import Sequence

import numpy as np

from experiments.common import Made, Options, Row, show_table, write_table
from experiments.sobol import sensitivity
from ltsim.effects import find_effect
from ltsim.effects.effect import Effect
from ltsim.planning.improvement import Predictor
from ltsim.planning.information import LayoutInformation
from ltsim.planning.workshop import survey_of
from ltsim.simulation.scenario import load_scenario
from ltsim.units import MICROMETRE


def effects_of(names: Sequence[str], stations: Sequence[str]) -> list[Effect]:
    """The effects that calibration does not know; one of a single station acts on all, each with its own size."""
    found: list[Effect] = []
    for name in names:
        kind = find_effect(name)
        found += [kind(stations=(s,)) for s in stations] if kind.scope == "station" else [kind()]
    return found


def run(given: Options) -> Made:
    """Predict, then take the predictions apart."""
    config = given.config
    samples = given.trials or config["samples"]
    indices: list[Row] = []
    spread: list[Row] = []
    for name in config["scenarios"]:
        survey = survey_of(load_scenario(name))
        effects = effects_of(config["left_out"], survey.station_names)
        predictor = Predictor.of(LayoutInformation.of(survey), effects)
        left_out = {effect.name for effect in effects}
        ranges = {
            group: tuple(config["range_left_out" if group in left_out else "range"]) for group in predictor.groups
        }
        rng = np.random.default_rng(config["seed"])
        sizes = {g: np.exp(rng.uniform(np.log(low), np.log(high), 2000)) for g, (low, high) in ranges.items()}
        expected = predictor.expected(sizes)
        for kind in ("distance", "coordinate"):
            gain = getattr(expected, f"{kind}_improvement")
            after = getattr(expected, f"{kind}_after") / MICROMETRE
            five, middle, most = np.percentile(gain, [5, 50, 95])
            spread.append({
                "scenario": name, "criterion": kind, "improvement_p5": five, "improvement_median": middle,
                "improvement_p95": most, "after_median_um": np.median(after),
            })  # fmt: skip
        found = sensitivity(predictor, ranges, samples=samples, seed=config["seed"])
        indices += [{"scenario": name} | index._asdict() for index in found]
    write_table(given.out / "indices.csv", indices)
    show_table(given.out / "improvement.csv", spread)
    return Made(config["seed"], samples)
