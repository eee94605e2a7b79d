"""What leaving out terms is worth that held-out targets speak against: on the tracker and on simulated ones."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

import ltsim as lt
from ltsim.arrays import Floats
from ltsim.calibration import calibrate_network
from ltsim.calibration.known import Choice
from ltsim.calibration.worth import point_errors
from ltsim.evaluation.two_face import compare_two_face
from ltsim.randomness import stream
from ltsim.recording import Recording
from ltsim.simulation.scenario import load_scenario

from .desy import EPOCHS, epoch, set_up

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


def measures() -> Rows:
    """Shares removed by six terms, all sixteen and the default, as one may sum up nine epochs and two directions."""
    halves: dict[tuple[str, int], list[tuple[Floats, Floats, Floats]]] = {}
    for name, source in product(EPOCHS, (0, 1)):
        own, other = (set_up(epoch(name), number) for number in (source, 1 - source))
        default = calibrate_network(own, advise=False)
        six = calibrate_network(own, advise=False, weigh=False, choice=Choice(parameters=FLIPPING))
        for method, values in (("six", six.values), ("16", default.values), ("default", default.applied)):
            found = compare_two_face(other, default.construction, values[0])
            pairs = (found.before.half[:, 1:], found.after.half[:, 1:], found.before.place[:, :1])
            halves.setdefault((method, source), []).append(pairs)
    rows: Rows = []
    for direction, unit in product(((0,), (1,), (0, 1)), ("angle", "length at the target")):
        for method in ("six", "16", "default"):
            chosen = [pairs for source in direction for pairs in halves[method, source]]
            scaled = [(b, a) if unit == "angle" else (b * d, a * d) for b, a, d in chosen]
            share = np.array([_share(b, a) for b, a in scaled])
            ways = {"median of epochs": np.median(share, axis=0), "mean of epochs": share.mean(axis=0),
                    "pooled": _share(*(np.concatenate(part) for part in zip(*scaled, strict=True)))}  # fmt: skip
            rows.append({"from": " and ".join(map(str, direction)), "of": unit, "method": method,
                         **{f"{way}, {axis}": f"{100 * value[k]:.1f}" for way, value in ways.items()
                            for k, axis in enumerate(("across", "elevation"))}})  # fmt: skip
    return rows


def _share(before: Floats, after: Floats) -> Floats:
    return 1.0 - np.sqrt(np.mean(after**2, axis=0) / np.mean(before**2, axis=0))


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
