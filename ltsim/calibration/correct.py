"""Correction of a recording: removal of the instrument's errors from its readings."""

import numpy as np

from ltsim.adjustment.start import initial_network
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import CalibrationSource, load_calibration
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError, RecordError, option_text
from ltsim.geometry.polar import swap_front_and_raw, to_polar, wrap_angle
from ltsim.physics.model.construction import GeometricErrorModel, ideal_construction
from ltsim.physics.model.incidence import incidence_reading_change
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.exchange import RecordingSource, load_recording
from ltsim.recordings.recording import Recording


def correct(
    recording: RecordingSource,
    calibration: CalibrationSource,
    *,
    allow_repeated: bool = False,
    allow_rejected: bool = False,
) -> Recording:
    """Recording that an ideal tracker would have made, computed with a calibration of the instrument.

    Each reading remains in its face. The set-up of the result declares its instruments corrected. In a row without a
    range or without an angle, the correction is computed for the adjusted position of the target, for which an accuracy
    of one millimetre is sufficient.

    Parameters
    ----------
    recording : Recording, str or Path
        Recording of the same instrument, with any network.
    calibration : Calibration, str or Path
    allow_repeated : bool
        Also correct readings that `setup.toml` declares corrected.
    allow_rejected : bool
        Also use a calibration whose readings contradict its model.

    Raises
    ------
    RecordError
        If the calibration does not contain the instrument of the recording, the readings of the calibration contradict
        its model, the readings of the recording are corrected already, or a file is malformed.
    NetworkError
        If rows lack a range or an angle and the network cannot be solved.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> corrected = lt.correct(recording, lt.calibrate(recording))
    >>> len(corrected)
    140
    """
    source, corrections = load_recording(recording), load_calibration(calibration)
    if not allow_repeated and any(source.instrument_of(name).corrected for name in source.stations):
        raise RecordError("setup.toml declares the readings corrected (corrected = true); correct readings only once")
    if corrections.is_rejected and corrections.instrument_parameter_names and not allow_rejected:
        raise RecordError(
            f"the readings of the calibration contradict its model (sigma0 = {corrections.uncertainty_factor:.3g}), "
            "and an unmodelled cause may distort its parameters: run ltsim diagnose on its recording, remove the cause "
            f"and calibrate again, or give {option_text('allow_rejected=True')} to use it nevertheless"
        )
    parameter_values = corrections.applied_values_for(source)
    uncorrected = source.with_readings(source.readings - incidence_reading_changes(source, corrections))
    readings = corrected_readings(uncorrected, corrections.construction, parameter_values)
    setup, mark = source.setup, {"corrected": True}
    instruments = {name: i.model_copy(update=mark) for name, i in setup.instruments.items()}
    marked_setup = {"instrument": setup.instrument.model_copy(update=mark), "instruments": instruments}
    return source.replace(setup=setup.model_copy(update=marked_setup), readings=readings)


def incidence_reading_changes(recording: Recording, calibration: Calibration) -> Floats:
    """Change of the readings by estimated incidence errors of the reflectors, shape (pointings, 3) [m, rad, rad].

    The change is zero if `setup.toml` declares no normals of nests, or if no approximate network can be computed.
    """
    reflectors = calibration.applied_reflectors
    model = MeasurementModel(recording, ideal_construction())
    if not any(error.reflector in reflectors for error in model.incidence_errors):
        return np.zeros(recording.readings.shape)
    try:
        (position, rotation, points), _ = initial_network(recording)
    except NetworkError:
        return np.zeros(recording.readings.shape)
    sightings = model.sightings(NetworkState(position, rotation, points, np.zeros((len(recording.instruments), 0))))
    return incidence_reading_change(recording, sightings, reflectors)


def corrected_readings(recording: Recording, construction: GeometricErrorModel, parameter_values: Floats) -> Floats:
    """Readings (pointings, 3) [m, rad, rad] of an ideal tracker for the measured points; NaN for missing readings.

    `parameter_values` are the instrument parameters, shape (parameters,) or (pointings, parameters) [SI].
    """
    raw_readings = np.where(
        recording.is_measured, recording.readings, _predicted_readings_of_incomplete_pointings(recording)
    )
    ideal = swap_front_and_raw(
        to_polar(construction.points_from_readings(raw_readings, parameter_values)), recording.face
    )
    change = ideal - raw_readings
    change[:, 1:] = wrap_angle(change[:, 1:])
    return np.where(recording.is_measured, raw_readings + change, np.nan)


def _predicted_readings_of_incomplete_pointings(recording: Recording) -> Floats:
    """Readings (pointings, 3) [m, rad, rad] of an ideal tracker, predicted for pointings without a range or an angle.

    The readings are computed from an approximate network; all are zero if every pointing is complete.
    """
    incomplete: Bools = np.asarray(~recording.is_measured.all(axis=1))
    if not incomplete.any():
        return np.zeros(recording.readings.shape)
    try:
        (position, rotation, points), lost = initial_network(recording)
    except NetworkError as problem:
        raise _undetermined_rows_error(incomplete, str(problem)) from None
    untied: Bools = incomplete & recording.is_measured.any(axis=1) & lost[recording.target]
    if untied.any():
        name = recording.targets[recording.target[int(np.argmax(untied))]]
        raise _undetermined_rows_error(untied, f"no reading connects target {name} to the network")
    model = MeasurementModel(recording, ideal_construction())
    return model.predict(NetworkState(position, rotation, points, np.zeros((1, 0))))


def _undetermined_rows_error(is_undetermined: Bools, reason_text: str) -> NetworkError:
    """Error for the pointings (flags `is_undetermined`) without a range or an angle whose target has no coordinates.

    `reason_text` is the reason for the missing coordinates.
    """
    return NetworkError(
        f"row {int(np.argmax(is_undetermined)) + 1} lacks a range or an angle, "
        f"and its target has no coordinates: {reason_text}"
    )
