"""Adjustments of real networks: GNU Gama, CERN, a storage ring, a total station; a simulated scanner with its truth.

    python -m experiments 04 [gama] [gama-tests] [cern] [ring] [geoeasy] [scanner]

The steps read ../shared/recordings and, if it exists, the repository of GNU Gama in ../gama. They write only results:
rows and set-ups are numbered in the order of the file.
"""

import time
from pathlib import Path

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from experiments.common import RECORDINGS, Options, RunRecord, print_line, run_steps, show_table
from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.prior_information import ParameterSelection
from ltsim.core.errors import RecordError
from ltsim.core.randomness import random_stream
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.model.construction import ideal_construction, misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings import Recording, read
from ltsim.recordings.recording import HEIGHT_COLUMNS, OBSERVABLES

from .published import GAMA, SCANNER_TRUTH, coordinates_and_sigmas, gama_result, scanner, scanner_recording

GAMA_TESTS = RECORDINGS.parents[1] / "gama" / "tests"
AGREE_UM = 5.0
"""Largest difference [um] of coordinates that agree: half of the last digit that gama-local prints."""
UNIT = (MILLIMETRE, ARCSECOND, ARCSECOND)
Rows = list[dict[str, object]]


def gama(out: Path) -> None:
    """Compare coordinates, sigma0, standard deviations and sums of squares with those that gama-local published."""
    rows: Rows = []
    for name in GAMA:
        recording, theirs = read(RECORDINGS / "gama-3d-networks" / f"{name}.gkf"), gama_result(name)
        ours = adjust(recording)
        reduced = adjust(to_marks(ours), start_state=ours.state)
        unit = theirs.apriori**2
        percent, reduced_percent = (100 * np.abs(sigma_ratio(a, name) - 1).max() for a in (ours, reduced))
        rows.append({
            "network": name, "dof": ours.dof, "dof_gama": theirs.dof,
            "sigma0": f"{ours.sigma0 * theirs.apriori:.5f}", "sigma0_gama": f"{theirs.aposteriori:.5f}",
            "largest_difference_mm": f"{1e3 * np.abs(difference(ours, name)).max():.6f}",
            "sum_of_squares": f"{ours.chi2 * unit:.5f}", "sum_of_squares_gama": f"{theirs.square_sum:.5f}",
            "at_the_coordinates_of_gama": f"{best_turns(ours, name) * unit:.5f}",
            "sigma_ratio_off_percent": f"{percent:.3f}", "by_lines_between_marks_percent": f"{reduced_percent:.3f}",
        })  # fmt: skip
    show_table(out / "gama.csv", rows)


def gama_tests(out: Path) -> None:
    """Compare the networks of GNU Gama's test suite with the published results; skipped without its repository."""
    outcomes: dict[str, list[tuple[str, float]]] = {}
    files = sorted(file for file in GAMA_TESTS.rglob("*.gkf") if file.with_suffix(".xml").exists())
    if not files:
        print_line(f"gama-tests: skipped, because {GAMA_TESTS} contains no networks; clone the repository of GNU Gama")
        return
    for file in files:
        try:
            ours, theirs = adjust(read(file)), gama_result(file.stem, file.parent)
        except RecordError as refused:
            outcomes.setdefault(f"refused: {str(refused).partition(': ')[2].partition(',')[0]}", []).append(
                (file.stem, 0.0)
            )
            continue
        largest_um = 1e6 * float(np.abs(coordinates_and_sigmas(ours, theirs)[0] - theirs.value).max())
        agree = ours.solution.has_converged and largest_um < AGREE_UM
        outcomes.setdefault("agree" if agree else "differ", []).append((file.stem, largest_um))
    show_table(out / "gama_tests.csv", [
        {
            "what": outcome, "networks": len(entries), "worst_um": f"{max(size for _, size in entries):.1f}",
            "names": " ".join(sorted(name for name, _ in entries)) if outcome == "differ" else "",
        }
        for outcome, entries in sorted(outcomes.items())
    ])  # fmt: skip


def difference(ours: Adjustment, name: str) -> np.ndarray:
    """Coordinates of ltsim minus those of gama-local (k,) [m]."""
    theirs = gama_result(name)
    return coordinates_and_sigmas(ours, theirs)[0] - theirs.value


def sigma_ratio(ours: Adjustment, name: str) -> np.ndarray:
    """Standard deviations of ltsim divided by those of gama-local (k,), both with the declared noise."""
    theirs = gama_result(name)
    used = theirs.aposteriori / theirs.apriori if name == "2019-prager" else 1.0
    return coordinates_and_sigmas(ours, theirs)[1] * used / theirs.sigma


def to_marks(ours: Adjustment) -> Recording:
    """Recording with readings reduced to the line between marks.

    This is the reduction of gama-local; the original readings belong to the line between instrument and prism.
    """
    recording = ours.recording
    targets = {n: t.model_copy(update={"height_mm": 0.0}) for n, t in recording.setup.targets.items()}
    stations = {n: s.model_copy(update={"instrument_height_mm": 0.0}) for n, s in recording.setup.stations.items()}
    flat = recording.replace(
        setup=recording.setup.model_copy(update={"targets": targets, "stations": stations}),
        covariates={k: v for k, v in recording.covariates.items() if k not in HEIGHT_COLUMNS},
    )
    marks = ours.state.station_positions - ours.problem.marks.instrument_offsets
    state = NetworkState(
        marks, ours.state.station_rotations, ours.state.target_points, ours.state.instrument_parameters
    )
    return flat.with_readings(MeasurementModel(flat, ideal_construction()).predict(state) + ours.residuals)


def best_turns(ours: Adjustment, name: str) -> float:
    """Smallest sum of squares if only orientations are adjusted.

    All points have the coordinates that gama-local printed.
    """
    theirs, recording, marks = gama_result(name), ours.recording, ours.problem.marks
    points, position = ours.state.target_points.copy(), ours.state.station_positions.copy()
    for point, axis, value in zip(theirs.names, theirs.axis, theirs.value, strict=True):
        if point in recording.targets:
            points[recording.targets.index(point), axis] = value
        for s, mark in enumerate(marks.mark_names):
            if mark == point:
                position[s, axis] = value + marks.instrument_offsets[s, axis]
    state = NetworkState(position, ours.state.station_rotations, points, ours.state.instrument_parameters)
    free = np.isin(np.arange(ours.problem.unknowns.n_columns), ours.problem.unknowns.pose_columns[:, 3:])

    def residual(turns: np.ndarray) -> np.ndarray:
        step = np.zeros(len(free))
        step[free] = turns
        return ours.problem.whitened_residuals(ours.problem.retract(state, step))

    return float(2 * least_squares(residual, np.zeros(free.sum()), xtol=1e-12, ftol=1e-12).cost)


CERN = {
    "ESA": "20697_V2_Dirk_ESA_experimental.lgc",
    "arc": "Arc_2_3.lgc",
    "single free set-up": "totalStationConvergence.lgc",
    "simulated example": "Title-Example-SIMULATED.lgc2",
}


def cern(out: Path) -> None:
    """Adjust networks of CERN with the declared noise, robustly, and with estimated noise.

    List the rejected readings.
    """
    summary, misfits, noise = [], [], []
    for name, file in CERN.items():
        recording = read(RECORDINGS / "cern-lgc-trackers" / file)
        for way, options in WAYS.items():
            start = time.process_time()
            adjustment = adjust(recording, **options)
            used = time.process_time() - start
            summary.append({"network": name, "way": way, **state_of(adjustment), "seconds": f"{used:.2f}"})
        misfits += [{"network": name, **row} for row in rejected_reading_rows(adjustment)]
        noise += [{"network": name, **row} for row in components(adjustment)]
    show_table(out / "cern.csv", summary)
    show_table(out / "cern_misfits.csv", misfits)
    show_table(out / "cern_noise.csv", noise)


WAYS: dict[str, dict[str, object]] = {
    "as stated": {},
    "robust": {"robust": True},
    "robust, noise estimated": {"robust": True, "noise_grouping": "instrument"},
}


def state_of(adjustment: Adjustment) -> dict[str, object]:
    """Size of an adjustment, rejected readings, sigma0, and numbers of outliers by w-test and tau-test."""
    recording = adjustment.recording
    return {
        "set_ups": len(recording.stations), "targets": len(recording.targets), "pointings": len(recording),
        "left_out": int(adjustment.is_rejected_reading.sum()), "dof": adjustment.dof,
        "sigma0": f"{adjustment.sigma0:.4f}",
        "outliers_w": len(adjustment.flagged_readings()),
        "outliers_tau": len(adjustment.flagged_readings(uses_estimated_noise=True)),
    }  # fmt: skip


def rejected_reading_rows(adjustment: Adjustment) -> Rows:
    """Row for each rejected reading, with its difference from the adjusted network."""
    rows: Rows = []
    for i, j in np.argwhere(adjustment.is_rejected_reading):
        miss, range_ = adjustment.residuals[i, j], adjustment.recording.readings[i, 0]
        rows.append({
            "row": int(i) + 1, "set_up": int(adjustment.recording.station[i]) + 1, "reading": OBSERVABLES[j],
            "error": f"{miss / UNIT[j]:.3f} {'mm' if j == 0 else 'arcsec'}",
            "error_at_target_mm": f"{1e3 * miss * (1.0 if j == 0 else range_):.3f}",
            "in_sigma": f"{miss / adjustment.problem.reading_sigmas[i, j]:.1f}", "range_m": f"{range_:.1f}",
        })  # fmt: skip
    return rows


def components(adjustment: Adjustment) -> Rows:
    """Variance components by instrument number and observable."""
    number = {name: i + 1 for i, name in enumerate(adjustment.recording.instruments)}
    return [{"instrument": number.get(c.instrument, "all"), "reading": c.observable, "factor": f"{c.noise_factor:.3f}",
             "sigma": f"{c.noise_factor_sigma:.3f}", "redundancy": f"{c.redundancy:.1f}"}
            for c in adjustment.variance_components]  # fmt: skip


RING = "field/esrf.lgc2"
EDGES_M = (2, 3, 4, 5, 6, 8, 10, 12, 15, 18, 22, 27, 32)
CLEAR_SIGMAS = 8.0


def ring(out: Path) -> None:
    """Test whether mean residuals by distance predict the residuals of other set-ups of the same tracker.

    The means of half of the set-ups of a tracker predict the residuals of the other half.
    """
    recording = read(RECORDINGS / RING)
    space = ResidualSpace.from_adjustment(adjust(recording, misalignment_construction()))
    residuals = np.full(space.is_used_reading.shape, np.nan)
    residuals[space.is_used_reading] = space.whitened_residuals[: int(space.is_used_reading.sum())]
    distance, tracker = recording.readings[:, 0], recording.instrument
    half = np.zeros(len(recording), dtype=int)
    for owner in np.unique(tracker):
        for k, station in enumerate(np.unique(recording.station[tracker == owner])):
            half[recording.station == station] = k % 2
    bins = np.digitize(distance, EDGES_M)
    rows: Rows = []
    for j, observable in enumerate(OBSERVABLES):
        use = np.isfinite(residuals[:, j])
        groups = {"distance": bins, "distance, each tracker": 100 * tracker + bins, "tracker": tracker}
        for by, group in groups.items():
            squares = sum(prediction_error(residuals[use, j], group[use], half[use] == k) for k in (0, 1))
            total = float(np.sum(residuals[use, j] ** 2))
            means = [residuals[use & (group == g), j] for g in np.unique(group)]
            clear = sum(len(m) > 1 and abs(m.mean()) > CLEAR_SIGMAS * m.std() / np.sqrt(len(m)) for m in means)
            rows.append({"observable": observable, "means_by": by, "chi2": f"{total:.0f}",
                         "predicted_fraction": f"{1 - squares / total:.3f}", "means": len(means),
                         f"beyond_{CLEAR_SIGMAS:.0f}_sigma": clear})  # fmt: skip
    show_table(out / "ring.csv", rows)


def prediction_error(residuals: np.ndarray, group: np.ndarray, predicted: np.ndarray) -> float:
    """Sum of squares of the `predicted` residuals minus the mean of the other residuals in their group."""
    means = {g: residuals[(group == g) & ~predicted].mean() for g in np.unique(group[~predicted])}
    return float(np.sum((residuals[predicted] - [means.get(g, 0.0) for g in group[predicted]]) ** 2))


def geoeasy(out: Path) -> None:
    """Estimate the noise of a total station with 22 set-ups in two faces, with and without instrument parameters."""
    recording = read(RECORDINGS / "geoeasy-total-station-22st" / "network.GSI")
    rows: Rows = []
    for name, built in (("none", ideal_construction()), ("16", misalignment_construction())):
        for way, options in (("as stated", {}), ("noise estimated", {"noise_grouping": "observable"})):
            adjustment = adjust(recording, built, robust=bool(options), **options)
            factors = {c.observable: f"{c.noise_factor:.2f}" for c in adjustment.variance_components}
            rows.append({"parameters": name, "way": way} | state_of(adjustment) | factors)
    show_table(out / "geoeasy.csv", rows)
    values, sigma = adjustment.state.instrument_parameters[0], np.sqrt(np.diag(adjustment.first_instrument_covariance))
    show_table(out / "geoeasy_parameters.csv", [
        {"parameter": p.name, "value": f"{v / p.si_per_display_unit:.2f}", "sigma": f"{s / p.si_per_display_unit:.2f}",
         "unit": p.unit}
        for p, v, s in zip(built.parameters, values, sigma, strict=True) if abs(v) > 3 * s
    ])  # fmt: skip


FIRST_ORDER = [e for e in ORDINARY_CALIBRATION_EFFECTS if set(SCANNER_TRUTH) & {p.name for p in e.parameters}]
PARAMETERS = [p for e in FIRST_ORDER for p in e.parameters]
UNITS = np.array([p.si_per_display_unit for p in PARAMETERS])
TRUTH = np.array([SCANNER_TRUTH[p.name] for p in PARAMETERS])


def scanner_truth(out: Path) -> None:
    """Compare four estimated parameters of a simulated scanner with their true values.

    The estimates are those of first order, and those with the exact kinematic chain.
    """
    rows: Rows = []
    for has_points in (True, False):
        recording = scanner(has_points)
        errors = np.array([fit_parameters(rounded_scans(trial), has_points)[0] - TRUTH for trial in range(80)])
        estimates, sigma = fit_parameters(recording, has_points)
        exact = adjust(recording, misalignment_construction(FIRST_ORDER)).state.instrument_parameters[0] / UNITS
        made_again = rounded_scans(None) if has_points else without_points(rounded_scans(None))
        form = adjust(made_again, misalignment_construction(FIRST_ORDER)).state.instrument_parameters[0] / UNITS - TRUTH
        gap = estimates - TRUTH
        joint = float(gap @ np.linalg.solve(np.cov(errors.T), gap))
        for k, p in enumerate(PARAMETERS):
            rows.append({
                "points": "given" if has_points else "unknown", "parameter": p.name, "unit": p.unit, "truth": TRUTH[k],
                "estimate": f"{estimates[k]:.1f}", "sigma": f"{sigma[k]:.1f}",
                "spread_by_rounding": f"{errors[:, k].std():.1f}",
                "error_in_spreads": f"{gap[k] / errors[:, k].std():.1f}", "joint_p": f"{stats.chi2.sf(joint, 4):.2f}",
                "exact_chain": f"{exact[k]:.1f}", "exact_less_first_order": f"{form[k]:.2f}",
            })  # fmt: skip
    show_table(out / "scanner.csv", rows)
    show_table(
        out / "scanner_choice.csv", [row for has_points in (True, False) for row in choice_of_parameters(has_points)]
    )


def choice_of_parameters(has_points: bool) -> Rows:
    """Estimates and standard deviations with all sixteen parameters, and with the four of the exercise."""
    recording = scanner(has_points)
    every, four = (
        calibrate_network(recording, recommend_measurements=False, choose_correction=False, parameter_selection=choice)
        for choice in (ParameterSelection(), ParameterSelection(estimated_parameters=tuple(SCANNER_TRUTH)))
    )
    rows: Rows = []
    for p in PARAMETERS:
        row: dict[str, object] = {"points": "given" if has_points else "unknown", "parameter": p.name, "unit": p.unit,
                                  "truth": SCANNER_TRUTH[p.name]}  # fmt: skip
        sigmas = []
        for label, calibration in (("16", every), ("4", four)):
            k = calibration.instrument_parameter_names.index(p.name)
            sigmas.append(calibration.sigma[0, k])
            row[f"estimate_{label}"] = f"{calibration.estimates[0, k] / p.si_per_display_unit:.1f}"
            row[f"sigma_{label}"] = f"{sigmas[-1] / p.si_per_display_unit:.2f}"
        rows.append(row | {"sigma_ratio": f"{sigmas[0] / sigmas[1]:.1f}"})
    return rows


def fit_parameters(recording: Recording, has_points: bool) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and their standard deviations (4,) [um, urad], to first order."""
    adjustment = adjust(recording if has_points else without_points(recording), effects=FIRST_ORDER)
    return adjustment.state.extra_parameters / UNITS, np.sqrt(np.diag(adjustment.effect_covariance)) / UNITS


def without_points(recording: Recording) -> Recording:
    """Recording without the reference coordinates of the object points."""
    return recording.replace(setup=recording.setup.model_copy(update={"targets": {}}))


def rounded_scans(trial: int | None) -> Recording:
    """Scans simulated from the declared truth and rounded to 0.1 mm as in the files.

    The poses are changed by random 0.1 mm and 0.1 mrad. The points of a ring have nearly the same height and are
    therefore rounded alike: their errors are correlated. With `trial=None` poses are not changed and coordinates not
    rounded.
    """
    base = scanner(True)
    start = adjust(base, effects=FIRST_ORDER).state
    objects = {n: np.array(base.target_setup(n).known_mm) * MILLIMETRE for n in base.targets}
    moved = np.zeros((2, 2, 3)) if trial is None else random_stream(4, "rounding", trial).normal(0, 1e-4, (2, 2, 3))
    state = NetworkState(
        start.station_positions + moved[0], matrix_from_rotation_vector(moved[1]) @ start.station_rotations,
        np.array(list(objects.values())),
        np.zeros((1, 0)), TRUTH * UNITS,
    )  # fmt: skip
    local = from_polar(MeasurementModel(base, ideal_construction(), tuple(FIRST_ORDER)).predict(state))
    local = local if trial is None else np.round(local, 4)
    scans = [{base.targets[t]: local[i] for i, t in enumerate(base.target) if base.station[i] == s} for s in range(2)]
    return scanner_recording(scans, objects, True)


STEPS = {
    "gama": gama,
    "gama-tests": gama_tests,
    "cern": cern,
    "ring": ring,
    "geoeasy": geoeasy,
    "scanner": scanner_truth,
}


def run(options: Options) -> RunRecord:
    """Run the steps that the command line names, or all steps."""
    run_steps(options, STEPS)
    return RunRecord(seed=4)
