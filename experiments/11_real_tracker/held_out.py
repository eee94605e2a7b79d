"""What leaving out terms is worth that held-out targets speak against: on simulated trackers."""

from collections.abc import Iterator
from itertools import product

import numpy as np

import ltsim as lt
from ltsim.calibration import calibrate_network
from ltsim.calibration.worth import point_errors
from ltsim.randomness import stream
from ltsim.recording import Recording
from ltsim.simulation.scenario import load_scenario

FLIPPING = ("transit-offset", "beam-offset", "beam-tilt", "transit-tilt", "vertical-index")
SCENARIO = "paper-workshop-two-face"
TRIALS = 40
LOOSE, SLIP = 0.08, 20e-6
"""Share of pointings to a reflector that sat badly, and by how much [m]."""
INSTRUMENTS = {
    "as stated": (1.0, False, False),
    "a third of it": (1 / 3, False, False),
    "six terms only, a third": (1 / 3, True, False),
    "six terms only, a third; reflectors that sat badly": (1 / 3, True, True),
}
"""Size in prior sigmas, whether only what flips with the face, and whether pointings slipped."""
Rows = list[dict[str, object]]


def simulated(trials: int = TRIALS) -> Rows:
    """Root mean square error [um] of a new point of simulated trackers by what is applied; set-ups calibrated from."""
    rows: Rows = []
    for stations, (instrument, how) in product((1, 2), INSTRUMENTS.items()):
        found = np.array([list(errors.values()) for errors in _trials(stations, trials, *how)])
        rms = np.sqrt(np.mean(found**2, axis=0))
        better = np.mean(found[:, 2] <= found[:, 1])
        ratio = found[:, 2] / found[:, 1]
        rows.append({"instrument": instrument, "set-ups": stations, "as read": f"{rms[0]:.1f}",
                     "all sixteen": f"{rms[1]:.2f}", "default": f"{rms[2]:.2f}",
                     "mean ratio default to all": f"{ratio.mean():.3f} +- {ratio.std() / np.sqrt(trials):.3f}",
                     "default no worse": f"{100 * better:.0f} %"})  # fmt: skip
    return rows


def _trials(stations: int, trials: int, size: float, only_six: bool, loose: bool) -> Iterator[dict[str, float]]:
    scenario = load_scenario(SCENARIO)
    whole, _ = lt.simulate(scenario, seed=0)
    reference = calibrate_network(whole, advise=False, weigh=False)
    assert reference.adjustment is not None
    form = point_errors(reference.adjustment)
    six = np.array([name.startswith(FLIPPING) for name in reference.names])
    units = np.array([p.factor for p in reference.construction.parameters])
    for seed in range(trials):
        true = size * reference.prior_sigma[0] * stream(seed, "tracker").standard_normal(len(six))
        true *= six if only_six else 1.0
        errors = dict(zip(reference.names, (true / units).tolist(), strict=True))
        own = scenario.model_copy(update={"instrument": scenario.instrument.model_copy(update={"errors": errors})})
        recording, _ = lt.simulate(own, seed=seed)
        recording = recording.select(recording.station < stations)
        found = calibrate_network(slipped(recording, seed) if loose else recording, advise=False)
        left = {"raw": -true, "all": found.values[0] - true, "default": found.applied[0] - true}
        yield {name: float(np.sqrt(gap @ form @ gap)) * 1e6 for name, gap in left.items()}


def slipped(recording: Recording, seed: int) -> Recording:
    """The recording with a few pointings to a place across the beam from where the reflector sat before."""
    rng, readings = stream(seed, "slipped"), recording.readings.copy()
    rows = rng.random(len(readings)) < LOOSE
    slip = SLIP * rng.standard_normal((int(rows.sum()), 2)) / readings[rows, :1]
    readings[rows, 1] += slip[:, 0] / np.cos(readings[rows, 2])
    readings[rows, 2] += slip[:, 1]
    return recording.with_readings(readings)
