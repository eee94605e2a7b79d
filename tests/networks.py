"""A small network for tests: the reference workshop (a reconstruction of the paper's), built without the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ltsim.adjustment import adjust
from ltsim.adjustment.evaluation.clouds import CalibrationErrors, align_to_points, measured_points, rms_point_error
from ltsim.adjustment.remedies.network import PlannedNetwork
from ltsim.adjustment.remedies.next_measurement import (
    RankedProposals,
    rank_informative_measurements,
    rank_measurements_between,
)
from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.model.construction import GeometricErrorModel, declared_construction, misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import GaugeDistance, LengthGauge, Setup, Target

STATIONS = np.array([[3.0, 3.0, 1.9], [4.6, 1.9, 2.0], [1.9, 4.6, 2.1], [5.3, 4.4, 1.95], [3.9, 5.5, 2.05]])
YAWS = np.radians([0.0, 75.0, 160.0, 230.0, 310.0])
GAUGE = np.array([[0.6, 0.6, 0.15], [0.9, 0.75, 0.25], [0.75, 0.95, 0.3], [1.1, 1.05, 0.35]])


def mesh() -> Floats:
    """24 targets on two walls and three levels, 4 gauge targets on the floor."""
    along = np.array([0.6, 2.2, 3.8, 5.4])
    points = []
    for z in (5.9, 2.0, 0.15):
        points += [[0.0, a, z] for a in along] + [[a, 0.0, z] for a in along]
    return np.vstack([np.array(points), GAUGE])


def normals() -> Floats:
    """Open faces of the nests: off the walls; the gauge looks into the room."""
    wall = [[1.0, 0.0, 0.0]] * 4 + [[0.0, 1.0, 0.0]] * 4
    return np.array(wall * 3 + [[0.7, 0.7, 0.14]] * 4)


@dataclass(frozen=True)
class Truth:
    """What a test network was made with."""

    state: NetworkState
    construction: GeometricErrorModel


def network(
    *,
    faces: int = 1,
    repeats: int = 1,
    values: Floats | None = None,
    seed: int | None = None,
    construction: GeometricErrorModel | None = None,
    stations: int = 5,
) -> tuple[Recording, Truth]:
    """A recording of the reference workshop; noise is added where a seed is given."""
    built = construction or misalignment_construction()
    points = mesh()
    names = tuple(f"T{i + 1:02d}" for i in range(len(points)))
    rows = [
        (s, t, f, r)
        for s in range(stations)
        for t in random_stream(1, "order", s).permutation(len(points))
        for f in range(1, faces + 1)
        for r in range(1, repeats + 1)
    ]
    station, target, face, repeat = np.array(rows, dtype=np.int64).T
    pairs = [(a, b) for a in range(24, 28) for b in range(a + 1, 28)]
    gauge = LengthGauge(
        distance=tuple(
            GaugeDistance.model_validate(
                {
                    "from": names[a],
                    "to": names[b],
                    "length_mm": 1e3 * float(np.linalg.norm(points[a] - points[b])),
                    "sigma_mm": 0.0018,
                }
            )
            for a, b in pairs
        )
    )
    setup = Setup(
        title="test network",
        gauge=gauge,
        targets={n: Target(nest_normal=tuple(v)) for n, v in zip(names, normals().tolist(), strict=True)},
    )
    recording = Recording(
        setup=setup,
        stations=tuple(f"S{i + 1}" for i in range(stations)),
        targets=names,
        station=station,
        target=target,
        face=face,
        repeat=repeat,
        time=20.0 * np.arange(len(rows)) + 600.0 * station,
        readings=np.full((len(rows), 3), np.nan),
    )
    instrument = np.zeros(built.n_parameters) if values is None else values
    rotation = np.stack([rotation_about_z(float(yaw)) for yaw in YAWS[:stations]])
    state = NetworkState(STATIONS[:stations], rotation, points, instrument[None])
    readings = MeasurementModel(recording, built).predict(state)
    recording = recording.with_readings(readings)
    if seed is not None:
        noise = random_stream(seed, "noise").standard_normal(readings.shape)
        recording = recording.with_readings(readings + recording.reading_sigmas() * noise)
    return recording, Truth(state, built)


def drawn(construction: GeometricErrorModel, seed: int) -> Floats:
    """Instrument parameters drawn from their priors."""
    sigma = np.array([p.prior_sigma for p in construction.parameters])
    return sigma * random_stream(seed, "instrument").standard_normal(construction.n_parameters)


def with_effect(effect: Effect, values: list[float], *, noise: float = 1.0, seed: int = 11) -> Recording:
    """A recording, its noise times `noise`, of a tracker without errors and with an effect of known size [SI]."""
    recording, truth = network(faces=2)
    model = MeasurementModel(recording, misalignment_construction(), (effect,))
    exact = model.predict(replace(truth.state, extra_parameters=np.array(values)))
    white = random_stream(seed, "noise").standard_normal(exact.shape)
    return recording.with_readings(exact + noise * recording.reading_sigmas() * white)


def share_removed(
    recording: Recording,
    points: Floats,
    construction: GeometricErrorModel,
    *,
    calibrated: Floats,
    true_parameters: Floats,
) -> CalibrationErrors:
    """Errors of what the stations measured against true points (T, 3): raw, calibrated, with the true parameters."""
    sizes = (None, calibrated, true_parameters)
    return CalibrationErrors(
        *(rms_point_error(recording, measured_points(recording, construction, v), points) for v in sizes)
    )


def target_error(points: Floats, true_points: Floats) -> float:
    """Rms [m] over targets (T, 3) of the distance of adjusted targets to the truth, after one rigid fit."""
    gap = align_to_points(points, true_points) - true_points
    return float(np.sqrt(np.nanmean(np.sum(gap**2, axis=1))))


def ranked_measurements(
    recording: Recording, explanations: Sequence[str] = (), with_effects: Sequence[LinearEffect] = ()
) -> RankedProposals:
    """Further measurements after a recording whose causes are not identified first, the best first."""
    adjustment = adjust(recording, declared_construction(recording))
    adjustment.solution.require_success()
    if len(explanations) > 1:
        return rank_measurements_between(adjustment, explanations, with_effects)
    return rank_informative_measurements(PlannedNetwork.from_adjustment(adjustment))
