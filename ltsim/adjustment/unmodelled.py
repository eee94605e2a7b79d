"""Uncertainty of adjusted places due to errors outside the adjustment: the air along the beams.

To first order the unknowns follow the whitened rows l of the adjustment by P = N^-1 A' (N the normal matrix, A the
whitened design). An error with the shift s of these rows moves the places by P s, so that its part of their covariance
is P s s' P'. Plans, adjustments, calibrations and uncertainties of tasks use these functions.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.core.arrays import AT_ONCE, Floats, Ints
from ltsim.core.units import PPM
from ltsim.geometry.rigid import rigid_motion
from ltsim.physics.effects.air import air_errors, turbulence_variance
from ltsim.physics.effects.rays import bending
from ltsim.recordings.air import Air

TEMPERATURE, GRADIENT, TURBULENCE = "temperature of the air", "gradient of the air", "turbulence"


def reach_of(adjustment: Adjustment, columns: Ints) -> Floats:
    """Displacement (m, k) of unknowns `columns` (k,) per unit of each whitened row of the adjustment."""
    unit = np.zeros((adjustment.problem.unknowns.size, len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    spread = adjustment.factor.covariance_columns(unit)
    if adjustment.datum is not None:
        spread = spread - adjustment.datum.carried @ adjustment.datum.motion[columns].T
    return np.asarray(adjustment.solution.system.design @ spread)


def counted_air(adjustment: Adjustment, air: Air | None = None) -> Air | None:
    """Uncertainty of the air (default that of the set-up) if the lines of sight are long enough; else None."""
    chosen = air or adjustment.recording.setup.air or Air()
    used = adjustment.problem.use.any(axis=1)
    return chosen if chosen.counts(longest_sight(adjustment)) and used.any() else None


def longest_sight(adjustment: Adjustment) -> float:
    """Longest range [m] of a reading in use."""
    return float(np.max(adjustment.sightings.range_, where=adjustment.problem.use.any(axis=1), initial=0.0))


def air_responses(adjustment: Adjustment, reach: Floats, air: Air) -> dict[str, Floats]:
    """Displacements (k, q) of unknowns by the air, by cause, with one column per standard deviation of a variate.

    Each station has a temperature and a gradient, each reading a turbulence. `reach` (m, k) belongs to these unknowns.
    """
    rows, columns, readings = _used(adjustment, reach)
    scale = adjustment.problem.sigma[rows, columns]
    common = readings * (air_errors(air, adjustment.sightings)[rows, columns] / scale[:, None]).T[:, None]
    station = adjustment.recording.station[rows]
    by_station = np.stack([common[..., station == s].sum(axis=-1) for s in np.unique(station)], axis=-1)
    scatter = readings * (np.sqrt(turbulence_variance(air, adjustment.sightings)[rows, columns]) / scale)
    responses = {TEMPERATURE: by_station[0], GRADIENT: by_station[1], TURBULENCE: scatter}
    return {name: response for name, response in responses.items() if np.any(response)}


def shared_air_errors(air: Air) -> tuple[str, str]:
    """Names of the errors of the air that all stations share.

    Poses and targets absorb them, so that residuals do not show them.
    """
    scale = air.temperature_k * bending() / PPM
    return (
        f"air {air.temperature_k:g} K warmer at all stations than its thermometer (scale {scale:.2g} ppm)",
        f"vertical gradient of {air.gradient_k_per_m:g} K/m at all stations",
    )


def common_responses(adjustment: Adjustment, reach: Floats, air: Air) -> dict[str, Floats]:
    """Displacements (k,) of unknowns by one standard deviation of each of the `shared_air_errors`."""
    rows, columns, readings = _used(adjustment, reach)
    shift = air_errors(air, adjustment.sightings)[rows, columns] / adjustment.problem.sigma[rows, columns][:, None]
    return dict(zip(shared_air_errors(air), (readings @ shift).T, strict=True))


def _used(adjustment: Adjustment, reach: Floats) -> tuple[Ints, Ints, Floats]:
    """Row and observable of each reading in use, and the displacements (k, r) per unit of these readings."""
    rows, columns = np.nonzero(adjustment.problem.use)
    return rows, columns, reach[: len(rows)].T


def air_covariance(adjustment: Adjustment, columns: Ints, air: Air | None = None) -> Floats:
    """Covariance (c, k, k) of sets (c, k) of unknowns due to the air; zero for short ranges."""
    counted = counted_air(adjustment, air)
    added = np.zeros((*columns.shape, columns.shape[1]))
    if counted is not None:
        for batch, part in _batches(adjustment, columns):
            added[batch] = _gram(air_responses(adjustment, part, counted), columns.shape[1])
    return added


def joint_air_covariance(adjustment: Adjustment, air: Air | None = None) -> Floats:
    """Covariance (3 T, 3 T) [m^2] of all targets due to the air; zero for short ranges."""
    columns = adjustment.problem.unknowns.target.reshape(1, -1)
    return air_covariance(adjustment, columns, air)[0]


def _gram(responses: Mapping[str, Floats], size: int) -> Floats:
    """Sum of the covariances (c, k, k) of responses (c k, q)."""
    parts = [response.reshape(-1, size, response.shape[1]) for response in responses.values()]
    return sum((part @ np.swapaxes(part, 1, 2) for part in parts), start=np.zeros(1))


def _batches(adjustment: Adjustment, columns: Ints) -> Iterator[tuple[slice, Floats]]:
    """Slices of sets (c, k) of unknowns with their displacements, as large as memory permits."""
    step = max(1, AT_ONCE // (adjustment.solution.system.design.shape[0] * columns.shape[1]))
    for first in range(0, len(columns), step):
        batch = slice(first, first + step)
        yield batch, reach_of(adjustment, columns[batch].ravel())


def hidden_displacements(adjustment: Adjustment, air: Air | None = None) -> dict[str, float]:
    """Rms displacement [m] of the targets by each error of the air that all stations share, after the best rigid fit.

    It is for one standard deviation; readings do not show the errors, so that no adjustment reports them.
    """
    chosen = air or adjustment.recording.setup.air or Air()
    targets = np.flatnonzero(~adjustment.problem.structure.unseen & ~adjustment.open_heights)
    columns = adjustment.problem.unknowns.target[targets]
    parts: dict[str, list[Floats]] = {name: [] for name in shared_air_errors(chosen)}
    for _, reach in _batches(adjustment, columns):
        for name, response in common_responses(adjustment, reach, chosen).items():
            parts[name].append(response)
    motion = rigid_motion(adjustment.state.points[targets])
    sizes = {}
    for name, responses in parts.items():
        moved = np.concatenate(responses) if responses else np.zeros(0)
        rest = moved - motion @ np.linalg.lstsq(motion, moved, rcond=None)[0]
        sizes[name] = float(np.sqrt(3.0 * np.mean(rest**2))) if len(rest) else 0.0
    return sizes
