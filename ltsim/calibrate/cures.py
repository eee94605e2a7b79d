"""What further measurement would determine a combination that a recording does not: found by computing it.

Each candidate adds pointings or a length to the network, at the adjusted places and with the stated noise, and asks
how much of the prior variance along each combination would then be gone. Nothing is measured: readings do not
enter a covariance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.adjust.loose import without_loose
from ltsim.adjust.problem import NetworkProblem
from ltsim.adjust.rows import GaugeRows
from ltsim.arrays import Floats, Ints
from ltsim.calibrate.undetermined import DETERMINED, Direction
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rotations import about_z
from ltsim.model.construction import Construction
from ltsim.model.measurement import MeasurementModel, State
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Gauge, GaugeDistance, Station
from ltsim.solve.blocks import Factor
from ltsim.units import DEGREE, MILLIMETRE

KNOWN_LENGTH = 2.0
"""[m] a length that a workshop can have calibrated."""
KNOWN_SIGMA_MM = 0.002
NEAR = 1.2
"""[m] range of near reflectors."""
MATERIAL = 0.05
"""Least rise of a gain that is worth a measurement."""


@dataclass(frozen=True)
class Network:
    """A recording that may hold pointings nobody made, and the state it would have."""

    recording: Recording
    state: State

    def covariance(self, construction: Construction) -> tuple[Floats, Floats]:
        """Covariance (I, p, p) of the instrument parameters, and their prior sigmas (I, p)."""
        model = MeasurementModel(self.recording, construction)
        problem = without_loose(NetworkProblem.of(model), self.state)
        kept = Factor(problem.linearise(self.state)).kept_covariance()
        at = problem.layout.instrument
        return kept[at[:, :, None], at[:, None, :]], problem.prior_sigma

    def with_pointings(self, station: Ints, target: Ints, face: Ints, construction: Construction) -> Network:
        """The network with further pointings, whose readings are those that the state predicts."""
        recording, count = self.recording, len(station)
        filler = np.full((count, 3), np.nan)
        added = recording.replace(
            station=np.concatenate([recording.station, station]),
            target=np.concatenate([recording.target, target]),
            face=np.concatenate([recording.face, face]),
            repeat=np.concatenate([recording.repeat, np.ones(count, dtype=np.int64)]),
            time=np.concatenate([recording.time, np.full(count, recording.time.max(initial=0.0))]),
            readings=np.concatenate([recording.readings, filler]),
            covariates={},
            labels={},
        )
        predicted = MeasurementModel(added, construction).predict(self.state)
        whole = np.concatenate([recording.readings, predicted[len(recording) :]])
        return Network(added.with_readings(whole), self.state)


def other_face(network: Network, construction: Construction) -> Network | None:
    """Every target that a station measured in one face only, in the other face as well."""
    recording = network.recording
    seen = set(zip(recording.station.tolist(), recording.target.tolist(), recording.face.tolist(), strict=True))
    missing = sorted((s, t, 3 - f) for s, t, f in seen if (s, t, 3 - f) not in seen)
    if not missing:
        return None
    station, target, face = np.array(missing, dtype=np.int64).T
    return network.with_pointings(station, target, face, construction)


def known_length(network: Network) -> tuple[str, Network]:
    """The pair of targets nearest to 2 m apart, with that length known; and their names."""
    recording, points = network.recording, network.state.points
    first, second = np.triu_indices(len(points), k=1)
    lengths = np.linalg.norm(points[first] - points[second], axis=1)
    best = int(np.argmin(np.abs(lengths - KNOWN_LENGTH)))
    names = recording.targets[first[best]], recording.targets[second[best]]
    gauge = recording.setup.gauge or Gauge()
    rows = GaugeRows.of(recording)
    taken = {frozenset(pair) for pair in zip(rows.first.tolist(), rows.second.tolist(), strict=True)}
    if frozenset((int(first[best]), int(second[best]))) in taken:
        return " and ".join(names), network
    # `from` is a keyword: the alias goes in through a mapping.
    length = {"from": names[0], "to": names[1], "length_mm": lengths[best] / MILLIMETRE}
    added = GaugeDistance(**length, sigma_mm=KNOWN_SIGMA_MM)
    setup = recording.setup.model_copy(
        update={"gauge": gauge.model_copy(update={"distance": (*gauge.distance, added)})}
    )
    return " and ".join(names), Network(recording.replace(setup=setup), network.state)


def near_targets(network: Network, construction: Construction) -> Network:
    """Four reflectors 1.2 m from each of the first two stations, seen from all stations in the faces in use."""
    state, recording = network.state, network.recording
    around = np.array([[NEAR, a * DEGREE, e * DEGREE] for a, e in ((0, 40), (90, -30), (180, 40), (270, -30))])
    centres = state.position[:2]
    points = np.concatenate([centre + from_polar(around) for centre in centres])
    names = tuple(f"near-{i + 1}" for i in range(len(points)))
    grown = dataclasses.replace(state, points=np.concatenate([state.points, points]))
    faces = np.unique(recording.face)
    grid = np.meshgrid(
        np.arange(len(recording.stations)), len(state.points) + np.arange(len(points)), faces, indexing="ij"
    )
    station, target, face = (axis.ravel() for axis in grid)
    wider = Network(recording.replace(targets=recording.targets + names), grown)
    return wider.with_pointings(station, target, face, construction)


def turned_station(network: Network, construction: Construction) -> Network:
    """The first station set up once more at its place, turned by 90 degrees, measuring the same again."""
    state, recording = network.state, network.recording
    mine = recording.station == 0
    known = recording.station_setup(recording.stations[0])
    name = f"{recording.stations[0]}-turned"
    stations = {**recording.setup.stations, name: Station(instrument=known.instrument)}
    setup = recording.setup.model_copy(update={"stations": stations})
    grown = dataclasses.replace(
        state,
        position=np.concatenate([state.position, state.position[:1]]),
        rotation=np.concatenate([state.rotation, state.rotation[:1] @ about_z(np.pi / 2)]),
    )
    wider = Network(recording.replace(setup=setup, stations=(*recording.stations, name)), grown)
    station = np.full(int(mine.sum()), len(recording.stations), dtype=np.int64)
    return wider.with_pointings(station, recording.target[mine], recording.face[mine], construction)


def start_of(adjustment: Adjustment, construction: Construction) -> Network:
    """The adjusted network as it is; an adjustment of corrected readings has no parameters, hence zeros."""
    recording, state = adjustment.recording, adjustment.state
    recording = recording.with_readings(np.where(adjustment.problem.use, recording.readings, np.nan))
    if state.instrument.shape[1] != construction.size:
        nothing = np.zeros((len(recording.instruments), construction.size))
        state = dataclasses.replace(state, instrument=nothing)
    return Network(recording, dataclasses.replace(state, extra=np.zeros(0)))


def candidates(network: Network, construction: Construction) -> Iterator[tuple[str, Network]]:
    """Further measurements worth a thought, each with the sentence that asks for it; the cheapest first."""
    both = other_face(network, construction)
    if both is not None:
        yield "measure every target in both faces", both
    names, known = known_length(network)
    yield f"calibrate a length of about 2 m, such as that between {names}", known
    turned = turned_station(network, construction)
    yield "turn the tracker by 90 degrees at the first station and measure again", turned
    near = near_targets(network, construction)
    yield "add reflectors at 1 to 1.5 m from two stations and measure them from all", near
    if both is not None:
        nearer = near_targets(both, construction)
        yield "measure in both faces, and add reflectors at 1 to 1.5 m from two stations", nearer


def cures(
    adjustment: Adjustment, construction: Construction, directions: Sequence[Sequence[Direction]]
) -> list[list[str]]:
    """For each instrument's undetermined directions a sentence: what would determine them.

    The first candidate that lifts a gain above one half is named, else the one that lifts it most.

    Parameters
    ----------
    adjustment : Adjustment
        Of the network as it is.
    construction : Construction
        Whose parameters are meant.
    directions : one sequence an instrument
    """
    if not any(directions):
        return [[] for _ in directions]
    network = start_of(adjustment, construction)
    asked = [("", network), *candidates(network, construction)]
    reached = [_gains_along(candidate, construction, directions) for _, candidate in asked]
    sentences = [sentence for sentence, _ in asked]
    return [
        [_sentence(direction, sentences, [gain[i][k] for gain in reached]) for k, direction in enumerate(own)]
        for i, own in enumerate(directions)
    ]


def _gains_along(
    network: Network, construction: Construction, directions: Sequence[Sequence[Direction]]
) -> list[list[float]]:
    """Gain along each direction of each instrument in a network."""
    covariance, prior = network.covariance(construction)
    found = []
    for block, sigma, own in zip(covariance, prior, directions, strict=True):
        scaled = block / np.outer(sigma, sigma)
        found.append([float(1.0 - d.vector @ scaled @ d.vector) for d in own])
    return found


def _sentence(direction: Direction, sentences: Sequence[str], gain: Sequence[float]) -> str:
    """The cure of one direction; `gain` belongs to `sentences`, the network as it is first."""
    if gain[0] >= DETERMINED > direction.gain:
        return f"use the network method: it determines this from the same recording (gain {gain[0]:.2f})"
    enough = [i for i in range(1, len(gain)) if gain[i] >= DETERMINED]
    best = enough[0] if enough else 1 + int(np.argmax(gain[1:]))
    if gain[best] - gain[0] < MATERIAL:
        return "none of the measurements that were tried shows it; only a tighter guarantee would"
    return f"{sentences[best]} (gain {direction.gain:.2f} to {gain[best]:.2f})"
