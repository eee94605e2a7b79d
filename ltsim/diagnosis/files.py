"""Output of a diagnosis: diagnosis.json, targets.csv, residuals and recording, written completely or not at all."""

from pathlib import Path

import numpy as np

from ltsim.adjustment.coordinate_uncertainty import (
    MAX_POINTS_IN_COVARIANCE_FILE,
    reported_joint_covariance,
)
from ltsim.calibration.files import covariance_file_texts, require_writable_covariance
from ltsim.diagnosis.diagnosis import RECORDING_FOLDER_NAME, Diagnosis
from ltsim.recordings.native import recording_texts
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import write_result


def write_diagnosis(
    diagnosis: Diagnosis, folder: Path, recording: Recording | None = None, *, with_stations: bool = False
) -> Diagnosis:
    """Diagnosis with the digests of its companion files, after all files have been written to a folder.

    `targets.csv` contains the coordinates adjusted with the findings in the model, and `targets.covariance.csv` their
    joint covariance with the variance between possible causes. `residuals.csv` contains the residuals of this
    adjustment, and `residuals_before.csv` those of the ordinary adjustment. `recording/` contains the recording, if it
    is given. With `with_stations`, `points.csv` and `points.covariance.csv` contain the targets and the stations.

    Raises
    ------
    RecordError
        When the folder cannot be written.
    ModelError
        When targets and stations are too many for a file with their joint covariance.
    """
    texts: dict[str, str] = {}
    adjustment, targets = diagnosis.final_adjustment, diagnosis.targets
    deviations = targets.weighted_deviations_by_explanation
    if with_stations:
        require_writable_covariance(adjustment)
        deviations = np.concatenate([deviations, targets.weighted_station_deviations_by_explanation], axis=1)
    if len(adjustment.recording.targets) <= MAX_POINTS_IN_COVARIANCE_FILE:
        covariance = reported_joint_covariance(adjustment, deviations, with_stations=with_stations)
        points = np.concatenate([targets.points, targets.station_positions])
        texts |= covariance_file_texts(adjustment, points, covariance)
    if recording is not None:
        copied = recording_texts(recording, folder / RECORDING_FOLDER_NAME)
        texts |= {f"{RECORDING_FOLDER_NAME}/{name}": text for name, text in copied.items()}
    return write_result(folder, diagnosis, texts)
