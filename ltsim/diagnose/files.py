"""diagnosis.json, targets.csv and residuals of a diagnosis, written whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.calibrate.files import residuals_csv
from ltsim.diagnose.diagnosis import Diagnosis
from ltsim.recording.files import write_texts
from ltsim.units import MILLIMETRE

JSON, TARGETS, AFTER, BEFORE = "diagnosis.json", "targets.csv", "residuals.csv", "residuals_before.csv"


def write_diagnosis(diagnosis: Diagnosis, folder: Path) -> None:
    """Write a diagnosis into a folder.

    `targets.csv` holds the coordinates adjusted with the findings modelled, `residuals.csv` what is left then,
    `residuals_before.csv` what the ordinary adjustment left.

    Raises
    ------
    RecordError
        When the folder cannot be written.
    """
    write_texts(
        folder,
        {
            JSON: json.dumps(diagnosis.to_json(), indent=1, allow_nan=False) + "\n",
            TARGETS: adjusted_targets_csv(diagnosis.adjusted, diagnosis.baseline),
            AFTER: residuals_csv(diagnosis.adjusted),
            BEFORE: residuals_csv(diagnosis.baseline),
        },
    )


def adjusted_targets_csv(adjusted: Adjustment, baseline: Adjustment) -> str:
    """The content of `targets.csv`, with the change of each coordinate against the ordinary adjustment."""
    sigma = np.sqrt(np.einsum("tii->ti", adjusted.target_covariance)) / MILLIMETRE
    points = adjusted.state.points / MILLIMETRE
    change = points - baseline.state.points / MILLIMETRE
    header = "target,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm,change_x_mm,change_y_mm,change_z_mm"
    lines = [header]
    for i, name in enumerate(adjusted.recording.targets):
        values = (*points[i], *sigma[i], *change[i])
        lines.append(",".join([name, *(f"{value:.6f}" for value in values)]))
    return "\n".join(lines) + "\n"
