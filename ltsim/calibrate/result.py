"""From an adjusted network to a calibration: what every method writes down in the same way."""

from __future__ import annotations

import numpy as np

from ltsim.adjust.adjustment import Adjustment, observable_name
from ltsim.adjust.screening import gross_pointings
from ltsim.adjust.start import start_network
from ltsim.arrays import Bools, Floats
from ltsim.calibrate.calibration import Combination, Fit, OutlierRow, StationPose, flat_names
from ltsim.calibrate.cures import cures
from ltsim.calibrate.undetermined import Direction, undetermined
from ltsim.errors import NetworkError
from ltsim.evaluate.criteria import Criteria, evaluate
from ltsim.geometry.rotations import quaternion
from ltsim.model.construction import Construction
from ltsim.recording.recording import Recording
from ltsim.units import ARCSECOND, MILLIMETRE

SHOWN_UNITS = (("mm", MILLIMETRE), ("arcsec", ARCSECOND), ("arcsec", ARCSECOND))
"""Unit of each column of the readings where a person reads it."""


def gross_rows(recording: Recording) -> Bools:
    """(n,) True for pointings that land elsewhere by more than any tracker error; raises NetworkError."""
    return gross_pointings(recording, *start_network(recording))


def fit_of(adjustment: Adjustment) -> Fit:
    """How the adjustment ended."""
    redundant = adjustment.dof > 0
    status = adjustment.solution.status
    return Fit(
        chi2=adjustment.chi2,
        dof=adjustment.dof,
        sigma0=adjustment.sigma0 if redundant else None,
        p_value=adjustment.p_value if redundant else None,
        iterations=adjustment.solution.iterations,
        status=status.name.lower(),
        sentence=status.value,
    )


def stations_of(adjustment: Adjustment, covariance: Floats | None = None) -> tuple[StationPose, ...]:
    """Poses with standard deviations; `covariance` (S, 6, 6), default that of the adjustment."""
    spread = adjustment.pose_covariance if covariance is None else covariance
    sigma = np.sqrt(np.maximum(np.einsum("sii->si", spread), 0.0))
    state = adjustment.state
    return tuple(
        StationPose(name, state.position[i], quaternion(state.rotation[i]), sigma[i, :3], sigma[i, 3:])
        for i, name in enumerate(adjustment.recording.stations)
    )


def outliers_of(adjustment: Adjustment) -> tuple[OutlierRow, ...]:
    """Gross pointings first, then single readings by the w-test."""
    recording = adjustment.recording

    def row(i: int, column: int, size: float, w: float, *, gross: bool) -> OutlierRow:
        unit, factor = SHOWN_UNITS[column]
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        return OutlierRow(i + 1, station, target, observable_name(column), size / factor, unit, w, gross)

    found = []
    for i in np.flatnonzero(adjustment.gross):
        scaled = np.nan_to_num(adjustment.residuals[i] / adjustment.problem.sigma[i])
        column = int(np.argmax(np.abs(scaled)))
        found.append(row(int(i), column, adjustment.residuals[i, column], float(scaled[column]), gross=True))
    single = [row(o.row, o.observable, o.size, o.w, gross=False) for o in adjustment.outliers()]
    return tuple(found + single)


def frame_of(adjustment: Adjustment) -> str:
    """A sentence: what the coordinates refer to."""
    problem, recording = adjustment.problem, adjustment.recording
    free = problem.free.shape[1]
    first = recording.stations[0]
    control = [recording.targets[i] for i in problem.control.target]
    levelled = [recording.stations[i] for i in problem.levels.station]
    if free == 6:
        return f"the frame of station {first}"
    if free == 0:
        return f"the frame of the control points {', '.join(control)}"
    if not control:
        return f"z follows the levels of {', '.join(levelled)}; the rest is the frame of station {first}"
    held = f"the control points {', '.join(control)}" + (" and the levels" if levelled else "")
    return f"{held}; what these leave free is held by station {first}"


def undetermined_of(
    adjustment: Adjustment, construction: Construction, directions: list[list[Direction]], *, advise: bool
) -> tuple[Combination, ...]:
    """The undetermined combinations of each instrument, named, with their cures (empty unless `advise`)."""
    instruments = adjustment.recording.instruments
    nothing = [[""] * len(own) for own in directions]
    sentences = cures(adjustment, construction, directions) if advise else nothing
    found = []
    for i, own in enumerate(directions):
        names = flat_names(construction.names, instruments)[i * construction.size :]
        for direction, cure in zip(own, sentences[i], strict=True):
            found.append(Combination(direction.coefficients(names), direction.gain, cure))
    return tuple(found)


def directions_of(covariance: Floats, prior_sigma: Floats) -> list[list[Direction]]:
    """Undetermined directions of each instrument; covariance (I p, I p), prior sigmas (I, p)."""
    count, size = prior_sigma.shape
    if not size:
        return [[] for _ in range(count)]
    blocks = covariance.reshape(count, size, count, size)
    return [undetermined(blocks[i, :, i], prior_sigma[i]) for i in range(count)]


def criteria_of(
    recording: Recording, adjustment: Adjustment, construction: Construction, values: Floats
) -> Criteria | None:
    """The paper's criteria without the gross pointings; None where stations cannot be compared."""
    try:
        if not construction.size:
            return evaluate(recording, use=~adjustment.gross)
        applied = values[0] if len(values) == 1 else values[recording.instrument]
        return evaluate(recording, construction, applied, use=~adjustment.gross)
    except NetworkError:
        return None
