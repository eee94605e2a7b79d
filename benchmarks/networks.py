"""Networks of any size for the benchmarks: stations around the middle of a room, targets on its walls."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ltsim.campaigns.true_network import TrueNetwork, make_true_network
from ltsim.geometry.polar import swap_front_and_raw, to_polar
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import NetworkState, sightings_at_state
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.recordings.setup import GaugeDistance, LengthGauge, Setup
from ltsim.simulation.draws import TrialDistributions
from ltsim.simulation.scenario import load_scenario


def workshop() -> TrueNetwork:
    """Network of the paper: 28 targets, 5 stations, one face."""
    return make_true_network(load_scenario("paper-workshop"), 1, "benchmark")


def room(stations: int, targets: int) -> TrueNetwork:
    """Stations on a circle of 1.5 m, and targets on a spiral over the walls of a room of 8 m.

    Four targets are a gauge.
    """
    turn = 2 * np.pi * np.arange(stations) / stations
    position = np.stack([1.5 * np.cos(turn), 1.5 * np.sin(turn), 1.6 + 0.3 * np.sin(3 * turn)], axis=1)
    around = 2 * np.pi * 0.618034 * np.arange(targets - 4)
    height = 0.3 + 4.5 * (np.arange(targets - 4) + 0.5) / (targets - 4)
    mesh = np.stack([4 * np.cos(around), 4 * np.sin(around), height], axis=1)
    gauge = np.array([[2.9, 0.0, 0.3], [3.2, 0.1, 0.32], [2.95, 0.45, 0.3], [3.25, 0.5, 0.35]])
    points, rotation = np.vstack([mesh, gauge]), np.array([rotation_about_z(float(a)) for a in turn])
    station, target = (a.ravel() for a in np.meshgrid(np.arange(stations), np.arange(targets), indexing="ij"))
    local = np.einsum("nji,nj->ni", rotation[station], points[target] - position[station])
    face = np.ones(len(station), dtype=np.int64)
    names = tuple(f"T{k:04d}" for k in range(targets))
    lengths = tuple(
        GaugeDistance.model_validate(
            {"from": names[a], "to": names[b], "length_mm": 1e3 * np.linalg.norm(points[a] - points[b]),
             "sigma_mm": 0.0025}
        )
        for a, b in combinations(range(targets - 4, targets), 2)
    )  # fmt: skip
    recording = Recording(
        setup=Setup(gauge=LengthGauge(distance=lengths)),
        stations=tuple(f"S{k:03d}" for k in range(stations)),
        targets=names,
        station=station.astype(np.int64),
        target=target.astype(np.int64),
        face=face,
        repeat=face,
        time=np.arange(len(station), dtype=np.float64),
        readings=swap_front_and_raw(to_polar(local), face),
    )
    built = misalignment_construction()
    state = NetworkState(position, rotation, points, np.zeros((1, built.n_parameters)))
    sigma = np.array([[p.prior_sigma_from(recording.setup.instrument.prior) for p in built.parameters]])
    population = TrialDistributions(
        sightings=sightings_at_state(recording, state),
        construction=built,
        instrument_names=("",),
        instrument_error_means=0 * sigma,
        instrument_error_sigmas=sigma,
        noise_sigmas=recording.reading_sigmas(),
        reference_lengths=ReferenceLengths.from_recording(recording),
        length_target_names=names,
    )
    return TrueNetwork(recording, state, population)
