"""The further measurement that would tell two explanations apart, chosen by computation.

Each measurement that a person could add is appended to the network as pointings not yet made. What the extended network
would leave of one explanation when the other is fitted instead is the expected evidence between them (a noncentrality).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.adjust.problem import NetworkProblem
from ltsim.adjust.residual_space import ResidualSpace, orthonormal
from ltsim.arrays import Floats, Ints
from ltsim.effects.signature import Signature
from ltsim.geometry.polar import to_face
from ltsim.geometry.rotations import about_z
from ltsim.model.measurement import MeasurementModel, State
from ltsim.recording.recording import Recording
from ltsim.solve.blocks import Factor
from ltsim.solve.gauss_newton import Solution, Status

DECISIVE = 10.0
"""Expected evidence (drop of chi2) from which two explanations count as told apart."""
SECONDS = 20.0

Extension = tuple[Recording, State]


def other_face(recording: Recording, state: State) -> Extension:
    """Every pointing again in the other face."""
    rows = np.flatnonzero(recording.repeat == recording.repeat.min())
    return _appended(recording, rows, face=3 - recording.face[rows]), state


def closing_points(recording: Recording, state: State) -> Extension:
    """The first three targets again before leaving each station."""
    rows, times = [], []
    for s in range(len(recording.stations)):
        here = np.flatnonzero(recording.station == s)
        here = here[np.argsort(recording.time[here], kind="stable")]
        first = list(dict.fromkeys(recording.target[here]))[:3]
        again = [int(here[np.argmax(recording.target[here] == t)]) for t in first]
        rows += again
        times += [float(recording.time[here].max()) + SECONDS * (i + 1) for i in range(len(again))]
    return _appended(recording, np.array(rows), time=np.array(times)), state


def reverse_order(recording: Recording, state: State) -> Extension:
    """Every station's targets again in the reverse order."""
    rows = np.argsort(-recording.time, kind="stable")
    return _appended(recording, rows), state


def return_visit(recording: Recording, state: State) -> Extension:
    """The first station again at the end, all targets."""
    return _new_station(recording, state, 0, 0.0)


def turned_base(recording: Recording, state: State) -> Extension:
    """A further set-up at the first station with the base turned by 70 degrees."""
    return _new_station(recording, state, 0, np.radians(70.0))


MEASUREMENTS: dict[str, Callable[[Recording, State], Extension]] = {
    "measure every target in the other face as well": other_face,
    "measure the first three targets again before leaving each station": closing_points,
    "measure every station's targets again in the reverse order": reverse_order,
    "go back to the first station at the end and measure all targets again": return_visit,
    "set the instrument up once more at the first station with its base turned by 70 degrees": turned_base,
}


def _appended(
    recording: Recording,
    rows: Ints,
    *,
    face: Ints | None = None,
    time: Floats | None = None,
    station: Ints | None = None,
) -> Recording:
    """The recording with some pointings made again, later."""
    later = recording.time.max() + SECONDS * (1.0 + np.arange(len(rows)))

    def both(column: Floats | Ints, new: Floats | Ints | None = None) -> Floats:
        return np.concatenate([column, column[rows] if new is None else new])

    return recording.replace(
        station=both(recording.station, station).astype(np.int64),
        target=both(recording.target).astype(np.int64),
        face=both(recording.face, face).astype(np.int64),
        repeat=both(recording.repeat, recording.repeat[rows] + recording.repeat.max()).astype(np.int64),
        time=both(recording.time, later if time is None else time),
        readings=np.concatenate([recording.readings, _raw_of(recording, rows, face)]),
        covariates={k: both(v) for k, v in recording.covariates.items()},
        labels={k: (*v, *(v[i] for i in rows)) for k, v in recording.labels.items()},
    )


def _raw_of(recording: Recording, rows: Ints, face: Ints | None) -> Floats:
    """Readings of rows, on another face where one is given; rough values, only their noise level matters."""
    readings = recording.readings[rows]
    if face is None:
        return readings
    front = to_face(readings, recording.face[rows])
    return to_face(front, face)


def _new_station(recording: Recording, state: State, like: int, yaw: float) -> Extension:
    rows = np.flatnonzero((recording.station == like) & (recording.repeat == recording.repeat.min()))
    index = len(recording.stations)
    name = f"{recording.stations[like]}-again"
    known = recording.setup.stations.get(recording.stations[like])
    setup = recording.setup
    if known is not None:
        setup = setup.model_copy(update={"stations": {**setup.stations, name: known}})
    extended = _appended(recording, rows, station=np.full(len(rows), index)).replace(
        stations=(*recording.stations, name), setup=setup
    )
    return extended, replace(
        state,
        position=np.vstack([state.position, state.position[like]]),
        rotation=np.concatenate([state.rotation, (state.rotation[like] @ about_z(yaw))[None]]),
    )


def planned_space(adjustment: Adjustment, extension: Extension) -> ResidualSpace:
    """The residual space that an extended network would have."""
    recording, state = extension
    plain = replace(state, extra=np.zeros(0))
    model = MeasurementModel(recording, adjustment.construction)
    planned = model.recording.with_readings(model.predict(plain))
    problem = NetworkProblem.of(MeasurementModel(planned, adjustment.construction))
    system = problem.linearise(plain)
    solution = Solution(plain, 0.0, 0, Status.CONVERGED, Factor(system), system)
    return ResidualSpace.of(Adjustment(problem, solution, np.zeros(len(planned), dtype=bool)))


def expected_evidence(space: ResidualSpace, truth: Signature, values: Floats, other: Signature) -> float:
    """Drop of chi2 by which an effect of given size would be told from another one."""
    rival = space.signature(other)
    left = space.project(space.signature(truth) @ values[:, None])
    columns = orthonormal(space.project(rival), rival)
    left = left - columns @ (columns.T @ left)
    return float((left**2).sum())


def separating_measurement(adjustment: Adjustment, truth: Signature, values: Floats, other: Signature) -> str:
    """A sentence: which further measurement would decide between two effects, and by how much."""
    state = adjustment.state
    now = expected_evidence(planned_space(adjustment, (adjustment.recording, state)), truth, values, other)
    best, gain = "", now
    for words, extend in MEASUREMENTS.items():
        if extend is other_face and (adjustment.recording.face == 2).any():
            continue
        space = planned_space(adjustment, extend(adjustment.recording, state))
        evidence = expected_evidence(space, truth, values, other)
        if evidence > gain:
            best, gain = words, evidence
    if gain < DECISIVE or not best:
        return (
            f"no further pointing that was tried tells {truth.name} from {other.name} "
            f"(expected chi-square {gain:.1f}); an independent measurement of the cause would"
        )
    return f"{best}: expected chi-square between {truth.name} and {other.name} from {now:.0f} to {gain:.0f}"
