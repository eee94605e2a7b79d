"""Comparison of several calibrations of one recording by their errors at new points, which no calibration used."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.adjustment.evaluation.clouds import CalibrationErrors, measured_points, rms_point_error
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.correct import correct
from ltsim.campaigns.spec import VALIDATION_STREAM_KEY, make_validation_scenario
from ltsim.core.arguments import check_argument_bounds
from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError
from ltsim.core.results import Result, Table, number_columns, text_columns
from ltsim.core.units import MICROMETRE
from ltsim.simulation.measurement_geometry import make_measurement_geometry
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import measure_trial
from ltsim.simulation.verbs import ScenarioSource, scenario

MAX_EQUAL_READING_DIFFERENCE = 1e-6
"""Largest difference [m, rad] between readings that count as equal. Rounding in a file causes smaller differences; the
noise of two different recordings causes larger differences."""
HELD_OUT_POINT_ERRORS_TABLE = Table(
    "new_points.csv",
    "rms errors, over stations and points, at points that no calibration used, including the noise of new readings",
    (
        *text_columns(calibration="name of the calibration"),
        *number_columns(
            display_format=".1f",
            error_raw_um="readings without corrections",
            error_calibrated_um="readings corrected by the estimates, or by the applied part of them",
            error_true_parameters_um="readings corrected by the true parameters: limit by noise and other effects",
        ),
        *number_columns(display_format=".3f", share_removed="removed fraction of the mean square above the limit"),
    ),
)


@dataclass(frozen=True, repr=False)
class HeldOutPointErrors(Result):
    """Errors at new points, for each of several calibrations of one recording, before and after their corrections."""

    errors_by_calibration: Mapping[str, CalibrationErrors]
    """Rms errors [m] at new points before and after correction of the readings, by name of the calibration."""

    def _summary_lines(self) -> list[str]:
        first_errors = next(iter(self.errors_by_calibration.values()))
        raw, floor = first_errors.raw_rms / MICROMETRE, first_errors.true_parameters_rms / MICROMETRE
        errors = ", ".join(
            f"{name} {error.calibrated_rms / MICROMETRE:.1f} um" for name, error in self.errors_by_calibration.items()
        )
        return [f"Error of a new point: uncorrected {raw:.1f} um, {errors}; with the true parameters {floor:.1f} um"]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {"new_points": lambda: HELD_OUT_POINT_ERRORS_TABLE.with_rows(self._table_rows())}

    def _table_rows(self) -> Iterator[list[Any]]:
        """Rows of the table of errors [um], one for each calibration."""
        for name, error in self.errors_by_calibration.items():
            sizes = (error.raw_rms, error.calibrated_rms, error.true_parameters_rms)
            yield [name, *(size / MICROMETRE for size in sizes), error.removed_error_fraction]


def _may_be_same_recording(readings: Floats, other_readings: Floats) -> bool:
    """True if two arrays of readings [m, rad] may come from the same recording.

    Arrays of the same recording may differ by rounding in files, and by readings that an adjustment excluded.
    """
    return readings.shape != other_readings.shape or not np.any(
        np.abs(readings - other_readings) > MAX_EQUAL_READING_DIFFERENCE
    )


def compare_calibrations(
    source: ScenarioSource,
    calibrations: Calibration | Mapping[str, Calibration],
    validation_scenario: str | Path,
    *,
    uses_applied_corrections: bool = False,
    seed: int = 0,
    trial: int = 0,
) -> HeldOutPointErrors:
    """Comparison of calibrations of one simulated recording at points that were not used for calibration.

    The same instruments with the same errors measure these points with independent noise, and each calibration corrects
    these readings. The rows of a campaign with the key `validation_points` contain the same errors.

    Parameters
    ----------
    source : Scenario, str or Path
        Scenario of the recording that was calibrated.
    calibrations : Calibration, or mapping of str to Calibration
        Calibrations by name, for the result.
    validation_scenario : str or Path
        New points: a scenario with other stations and targets, or a table ``NAME.csv`` of points that are measured from
        the stations of the recording.
    uses_applied_corrections : bool
        True to evaluate the corrections that `correct` applies, in place of the estimates, like the key of this name
        of a method in a campaign file.
    seed, trial : int
        Seed and number of the trial with which the recording was simulated.

    Raises
    ------
    InputError
        If a scenario does not exist, the stations of `validation_scenario` name other trackers than the recording, or a
        calibration belongs to another recording.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> calibrations = {method: lt.calibrate(recording, method=method) for method in ("network", "distance")}
    >>> comparison = lt.compare_calibrations("paper-workshop", calibrations, "paper-laboratory", seed=7)
    >>> comparison.to_dataframe()["calibration"].to_list()
    ['network', 'distance']
    """
    check_argument_bounds(seed=seed, trial=trial, required_argument="seed trial")
    base_scenario = scenario(source)
    place = Path() if isinstance(source, Scenario) else Path(source)
    made, truth = measure_trial(make_measurement_geometry(base_scenario, seed), seed, trial)
    by_name = {"calibration": calibrations} if isinstance(calibrations, Calibration) else calibrations
    for name, calibration in by_name.items():
        readings = (
            calibration.adjustment.recording.readings
            if calibration.adjustment and calibration.method == "network"
            else made.readings
        )
        if not _may_be_same_recording(readings, made.readings):  # the distance methods adjust corrected readings
            raise InputError(f"calibration '{name}' is not from seed {seed} and trial {trial}; give its seed and trial")
    if not by_name:
        raise InputError("no calibration is given, expected at least one")
    true_values = np.array([*truth.instrument_values.values()]).reshape(len(base_scenario.trackers_in_use), -1)
    geometry = make_measurement_geometry(
        make_validation_scenario(str(validation_scenario), base_scenario, place), seed, VALIDATION_STREAM_KEY
    )
    recording, there = measure_trial(
        geometry, seed, trial, true_instrument_errors=true_values, stream_key=VALIDATION_STREAM_KEY
    )

    def error(points: Any) -> float:
        return rms_point_error(recording, points, there.target_points)

    raw_errors = error(measured_points(recording))
    floor = error(measured_points(recording, geometry.construction, true_values[geometry.sightings.instrument]))
    calibration_by_name = (
        by_name
        if uses_applied_corrections
        else {name: calibration.with_changes(correction=None) for name, calibration in by_name.items()}
    )
    corrected_by_name = {
        name: measured_points(correct(recording, calibration, allow_repeated=True, allow_rejected=True))
        for name, calibration in calibration_by_name.items()
    }
    return HeldOutPointErrors(
        {name: CalibrationErrors(raw_errors, error(points), floor) for name, points in corrected_by_name.items()}
    )
