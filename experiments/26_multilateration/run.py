"""Ranges from many places, or everything from one: point errors at an equal number of pointings."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import Made, Options, batches, show_table, spread_out
from ltsim.adjustment import adjust
from ltsim.arrays import Floats
from ltsim.simulation.scenario import Scenario, changed, load_scenario
from ltsim.simulation.simulator import simulate
from ltsim.tasks.measurands import best_fit

TRIALS, SEED, BLOCK = 400, 26, 25
RANGES = ["distance"]
ADM = {"distance_mm": 0.003, "distance_ppm": 0.3, "azimuth_arcsec": 0.37, "elevation_arcsec": 0.37}
IFM = ADM | {"distance_mm": 0.0005, "distance_ppm": 0.2}
WAYS: dict[str, dict[str, Any]] = {
    "one station, all readings, five times": {"stations": 1, "work.repeats": 5},
    "five stations, all readings": {},
    "five stations, ranges alone": {"instrument.observables": RANGES},
    "five stations, ranges alone, interferometer": {"instrument.observables": RANGES, "instrument.noise": IFM},
    "five stations, all readings, interferometer": {"instrument.noise": IFM},
}
HANDS = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]])
"""Ranges have no hand: a mirror image counts as the network."""
ERRORS = {"without constants": {"draw": False}, "constants as the maker guarantees, not calibrated": {"draw": True}}


def scenario_of(errors: dict[str, bool], way: dict[str, Any]) -> Scenario:
    """The paper's workshop with 140 pointings in one of the ways."""
    plain = load_scenario("paper-workshop")
    own = {key: value for key, value in way.items() if key != "stations"}
    table = changed(plain, {"instrument.errors": errors, "instrument.noise": ADM, **own}, Path("paper-workshop"))
    if way.get("stations") == 1:
        first = next(iter(table.stations))
        table = table.model_copy(update={"stations": {first: table.stations[first]}})
    return table


def _missed(truth: Floats, points: Floats) -> float:
    """Root mean square distance [m] of points (T, 3) from the truth after a best fit."""
    rotation, shift, _ = best_fit(truth, points)
    gap = points - (truth @ rotation.T + shift)
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def errors_of(scenario: Scenario, start: int, count: int) -> Floats:
    """Root mean square (count,) [m] of the errors of the targets' coordinates after a best fit to the truth."""
    sizes = np.empty(count)
    for i in range(count):
        recording, truth = simulate(scenario, SEED + start + i)
        found = adjust(recording)
        found.solution.require_success()
        at = [found.recording.targets.index(name) for name in truth.targets]
        sizes[i] = min(_missed(truth.points, found.state.points[at] * hand) for hand in HANDS)
    return sizes


def run(options: Options) -> Made:
    """The table is multilateration.csv."""
    trials = options.trials or TRIALS
    rows = []
    for case, errors in ERRORS.items():
        for name, way in WAYS.items():
            scenario = scenario_of(errors, way)
            work = [(scenario, BLOCK * number, width) for number, width in batches(trials, BLOCK)]
            sizes = np.concatenate(spread_out(errors_of, work, options.jobs))
            mean = float(np.sqrt(np.mean(sizes**2)))
            sigma = float(np.std(sizes**2, ddof=1) / np.sqrt(trials) / (2 * mean))
            found = {"rms_um": round(1e6 * mean, 2), "uncertainty_um": round(1e6 * sigma, 2)}
            rows.append({"case": case, "way": name} | found)
    show_table(options.out / "multilateration.csv", rows)
    return Made(seed=SEED, trials=trials)
