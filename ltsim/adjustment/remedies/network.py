"""Network with hypothetical pointings: a recording, extended by measurements that have not been made.

The adjusted network predicts the readings of hypothetical pointings. Covariances do not depend on readings, so that an
adjustment of the extended network gives the precision after these pointings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.rows import GaugeRows
from ltsim.core.arrays import Floats, Ints
from ltsim.core.units import MILLIMETRE
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import DISTANCE_KIND_COLUMN, SHARED_ERROR_COLUMN_PATTERN, Recording
from ltsim.recordings.setup import GaugeDistance

DEFAULT_POINTING_TIME = 15.0
"""Assumed time [s] from one pointing to the next in a recording without times."""


@dataclass(frozen=True)
class PlannedNetwork:
    """Recording that may contain hypothetical pointings, and the network state that predicts their readings."""

    recording: Recording
    """Recording with the real and the hypothetical pointings."""
    state: NetworkState
    """Poses, coordinates and parameters that predict the readings."""
    construction: GeometricErrorModel
    """Geometric error model of the instrument, whose parameters are estimated."""
    prior: ParameterPrior | None = None
    """Prior of the instrument parameters; None for the prior in `setup.toml`."""

    @classmethod
    def from_adjustment(cls, adjustment: Adjustment, construction: GeometricErrorModel | None = None) -> PlannedNetwork:
        """Planned network that contains the pointings of an adjustment, without its rejected readings.

        The geometric error model is `construction`, by default that of the adjustment. With another number of
        parameters, the parameters are zero.
        """
        built, state = construction or adjustment.construction, adjustment.state
        recording = adjustment.recording
        values, prior = (
            state.instrument_parameters,
            adjustment.problem.prior if adjustment.construction == built else None,
        )
        if values.shape[1] != built.n_parameters:
            values = np.zeros((len(recording.instruments), built.n_parameters))
        readings = np.where(adjustment.problem.is_used_reading, recording.readings, np.nan)
        return cls(
            recording.with_readings(readings),
            replace(state, instrument_parameters=values, extra_parameters=np.zeros(0)),
            built,
            prior,
        )

    def make_adjustment(self) -> Adjustment:
        """Adjustment of this network at its state; raises NetworkError if a pose is undetermined.

        The adjustment is not cached: each of many candidate measurements has one, which takes 8 MB in a large network.
        """
        return Adjustment.from_plan(self.recording, self.state, self.construction, prior=self.prior)

    def parameter_covariance_and_prior_sigma(self) -> tuple[Floats, Floats]:
        """Posterior covariances (I, p, p), prior standard deviations (I, p) [SI] of p parameters of I instruments."""
        adjustment = self.make_adjustment()
        problem = adjustment.problem
        return adjustment.covariance_submatrices(problem.unknowns.instrument_columns), problem.prior.sigma

    @property
    def seconds_per_pointing(self) -> float:
        """Median time [s] from one pointing to the next; `DEFAULT_POINTING_TIME` without times."""
        recording = self.recording
        if not recording.has_clock or len(recording) < 2:
            return DEFAULT_POINTING_TIME
        return float(np.median(np.diff(np.sort(recording.time)))) or DEFAULT_POINTING_TIME

    def with_pointings(
        self, station: Ints | int, target: Ints, face: Ints | int, time: Floats | float | None = None
    ) -> PlannedNetwork:
        """Network with k additional pointings from the stations `station` to the targets `target`.

        `station` and `target` (k,) are indices, `face` (k,) is 1 or 2; `station` and `face` may be one number for all
        pointings. `time` [s] is the time of each additional pointing (k,), or of the first one; by default the
        additional pointings come after the last pointing of the recording.
        """
        recording, count, step = self.recording, len(target), self.seconds_per_pointing
        times = np.asarray(recording.time.max(initial=-step) + step if time is None else time)
        times = times if times.ndim else times + step * np.arange(count)
        last_index = int(np.argmax(recording.time))
        distance_kind = "horizontal" if recording.is_horizontal_distance[recording.is_measured[:, 0]].all() else ""

        def append_rows(column: Floats | Ints, new_rows: Floats | Ints | float) -> Floats:
            return np.concatenate([column, np.broadcast_to(new_rows, (count, *column.shape[1:])).astype(column.dtype)])

        full_recording = recording.replace(
            station=append_rows(recording.station, station),
            target=append_rows(recording.target, target),
            face=append_rows(recording.face, face),
            repeat=append_rows(recording.repeat, int(recording.repeat.max(initial=0)) + 1),
            time=append_rows(recording.time, times),
            readings=append_rows(recording.readings, np.nan),
            covariates={
                key: append_rows(column, np.nan if SHARED_ERROR_COLUMN_PATTERN.fullmatch(key) else column[last_index])
                for key, column in recording.covariates.items()
            },
            labels={
                key: (*column, *([distance_kind if key == DISTANCE_KIND_COLUMN else ""] * count))
                for key, column in recording.labels.items()
            },
        )
        prediction = MeasurementModel(full_recording, self.construction).predict(self.state)[len(recording) :]
        is_read = np.array(
            [
                recording.is_measured[recording.instrument == i].any(axis=0)
                for i in range(len(full_recording.instruments))
            ]
        )
        prediction[~is_read[full_recording.instrument[len(recording) :]]] = np.nan
        return replace(self, recording=full_recording.with_readings(np.concatenate([recording.readings, prediction])))

    def with_station(self, name: str, template_station: int, position: Floats, rotation: Floats) -> PlannedNetwork:
        """Network with an additional set-up `name` at a position (3,) [m] with a rotation matrix (3, 3).

        Instrument and levelling are copied from the station with the index `template_station`.
        """
        recording, state = self.recording, self.state
        station_setup = recording.station_setup(recording.stations[template_station])
        fresh = station_setup.model_copy(
            update={"position_mm": None, "yaw_deg": None, "yaw_sigma_arcsec": None, "over": None}
        )
        setup = recording.setup.model_copy(update={"stations": {**recording.setup.stations, name: fresh}})
        places, turns = (
            np.vstack([state.station_positions, position]),
            np.concatenate([state.station_rotations, rotation[None]]),
        )
        new_recording = recording.replace(setup=setup, stations=(*recording.stations, name))
        return replace(
            self, recording=new_recording, state=replace(state, station_positions=places, station_rotations=turns)
        )

    def with_targets(self, names: Sequence[str], points: Floats) -> PlannedNetwork:
        """Network with k additional targets at `points` (k, 3) [m], which no pointing measures yet."""
        new_recording = self.recording.replace(targets=(*self.recording.targets, *names))
        return replace(
            self,
            recording=new_recording,
            state=replace(self.state, target_points=np.vstack([self.state.target_points, points])),
        )

    def with_length(self, first_target: int, second_target: int, sigma_mm: float) -> PlannedNetwork:
        """Network with a calibrated length between two targets (indices), with the standard deviation `sigma_mm` [mm].

        The network is unchanged if the length is a reference length already.
        """
        recording, rows = self.recording, GaugeRows.from_recording(self.recording)
        if {first_target, second_target} in (
            set(pair) for pair in zip(rows.first_targets.tolist(), rows.second_targets.tolist(), strict=True)
        ):
            return self
        length_mm = (
            float(np.linalg.norm(self.state.target_points[first_target] - self.state.target_points[second_target]))
            / MILLIMETRE
        )
        # `from` is a keyword of Python, so that the alias is passed by a mapping.
        end_names: dict[str, Any] = {
            "from": recording.targets[first_target],
            "to": recording.targets[second_target],
            "length_mm": length_mm,
        }
        new_length = GaugeDistance(**end_names, sigma_mm=sigma_mm, measured_in_place=True)
        gauge = recording.gauge.model_copy(update={"distance": (*recording.gauge.distance, new_length)})
        return replace(self, recording=recording.replace(setup=recording.setup.model_copy(update={"gauge": gauge})))
