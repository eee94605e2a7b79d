"""Entries of a calibration result that all methods derive from the adjusted network."""

from typing import Any

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.axes import scale_error_of_declared_axes
from ltsim.adjustment.datum import motions_about_centre
from ltsim.adjustment.evaluation.criteria import CriteriaEntry, evaluate_criteria
from ltsim.adjustment.frame import DeclaredFrame
from ltsim.adjustment.reference_tests import ERROR_UNIT_BY_REFERENCE_KIND
from ltsim.adjustment.remedies.undetermined import (
    ParameterCombination,
    undetermined_combinations,
)
from ltsim.adjustment.significance import MAX_CHANCE_SIGMAS
from ltsim.adjustment.verdict import FitWithConstants, Verdict, trusted_outliers, verdict_on
from ltsim.calibration.schema import (
    OBSERVABLE_DISPLAY_UNITS,
    AxesEntry,
    FitEntry,
    FittedParameterEntry,
    NoiseRow,
    OutlierRow,
    ReferenceValueTestEntry,
    ReflectorEntry,
    StationPose,
)
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.core.notation import names_text, with_sigma
from ltsim.core.probability import TWO_SIDED_GLOBAL_TEST_LEVEL
from ltsim.core.units import ARCSECOND, MICROMETRE, MILLIMETRE, PPM
from ltsim.geometry.rigid import quaternion_from_matrix, rigid_motion_jacobian
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.physics.effects.range_mode import RangeMode
from ltsim.physics.effects.scale_causes import temperature_errors_text
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.effects.target_moved import moved_coordinates_sentence, moved_target_names
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.measurement import smr_radius_offsets
from ltsim.recordings.recording import DISTANCE_METER_COLUMN, OBSERVABLES, Recording

HEIGHT_MASK = np.array([False, False, True])
"""Mask (3,) that selects the height among the coordinates of a point."""


def fit_entry(adjustment: Adjustment) -> FitEntry:
    """Result entry with the fit statistics of an adjustment and the status of its convergence."""
    redundant = adjustment.dof > 0
    status = adjustment.solution.status
    return FitEntry(
        chi2=adjustment.chi2,
        dof=adjustment.dof,
        sigma0=adjustment.sigma0 if redundant else None,
        p_value=adjustment.p_value if redundant else None,
        iterations=adjustment.solution.n_iterations,
        status=status.name.lower(),
        sentence=status.value,
        chi2_sigma=None,
    )


def reflector_entries(adjustment: Adjustment) -> tuple[ReflectorEntry, ...]:
    """Entries of the estimated incidence errors of reflectors in fixed nests."""
    model, covariance = adjustment.problem.model, adjustment.effect_covariance
    values, units = model.incidence_parameters_by_reflector(adjustment.state.extra_parameters), SmrIncidence.parameters
    reflector_list = []
    for error, at in zip(model.incidence_errors, model.incidence_parameter_slices, strict=True):
        sigma = np.sqrt(np.einsum("ij,jk,ik->i", error.covariance_root, covariance[at, at], error.covariance_root))
        cells = zip(units, values[error.reflector].tolist(), sigma.tolist(), strict=True)
        parameters = tuple(
            FittedParameterEntry(
                name=p.name, value=value / p.si_per_display_unit, sigma=spread / p.si_per_display_unit, unit=p.unit
            )
            for p, value, spread in cells
        )
        reflector_list.append(ReflectorEntry(reflector=error.reflector, parameters=parameters))
    return tuple(reflector_list)


def station_poses(adjustment: Adjustment, covariance: Floats | None = None) -> tuple[StationPose, ...]:
    """Poses of the stations with standard deviations from `covariance` (stations, 6, 6).

    By default `covariance` is that of the adjustment.
    """
    spread = adjustment.pose_covariance if covariance is None else covariance
    sigma = np.sqrt(np.maximum(np.einsum("sii->si", spread), 0.0))
    state, over = adjustment.state, adjustment.problem.marks.target_indices
    flat = (over >= 0) & adjustment.is_height_undetermined_target[over]
    return tuple(
        StationPose(
            name=name,
            position_mm=np.where(flat[i] & HEIGHT_MASK, np.nan, state.station_positions[i] / MILLIMETRE).tolist(),
            rotation_quaternion=quaternion_from_matrix(state.station_rotations[i]).tolist(),
            sigma_position_mm=(sigma[i, :3] / MILLIMETRE).tolist(),
            sigma_rotation_arcsec=(sigma[i, 3:] / ARCSECOND).tolist(),
        )
        for i, name in enumerate(adjustment.recording.stations)
    )


def outlier_rows(adjustment: Adjustment, fit_with_constants: FitWithConstants | None = None) -> tuple[OutlierRow, ...]:
    """Result entries of outlying readings: gross errors, other excluded readings, then those that tests flag.

    `fit_with_constants` also estimates the instrument constants; None if there is no such fit.
    """
    recording = adjustment.recording
    whitened = np.nan_to_num(adjustment.residuals / adjustment.problem.reading_sigmas)

    def outlier(i: int, column: int, size_si: float, w: float, **other_fields: Any) -> OutlierRow:
        unit, factor = OBSERVABLE_DISPLAY_UNITS[column]
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        named = {"row": i + 1, "station": station, "target": target, "observable": OBSERVABLES[column], "unit": unit}
        return OutlierRow(size=size_si / factor, w=w, **named, **other_fields)

    outliers = []
    for i in np.flatnonzero(adjustment.is_gross_pointing).tolist():
        k = int(np.argmax(np.abs(whitened[i])))
        residual, w = adjustment.residuals[i, k], float(whitened[i, k])
        outliers.append(outlier(i, k, residual, w, pointing_excluded=True, excluded=True))
    single = adjustment.is_rejected_reading & ~adjustment.is_gross_pointing[:, None]
    single &= _estimated_error_mask(adjustment, whitened)
    for i, k in sorted(np.argwhere(single).tolist(), key=lambda at: -abs(whitened[at[0], at[1]])):
        outliers.append(outlier(i, k, adjustment.residuals[i, k], float(whitened[i, k]), excluded=True))
    for o in trusted_outliers(adjustment, TWO_SIDED_GLOBAL_TEST_LEVEL, fit_with_constants):
        place = o.pointing_index, o.observable_column
        outliers.append(outlier(*place, o.estimated_error, o.normalised_residual, p_value=o.p_value))
    return tuple(outliers)


def _estimated_error_mask(adjustment: Adjustment, whitened_residuals: Floats) -> Bools:
    """Mask (pointings, 3) of the readings whose residual is an estimate of their error.

    For a target without determined coordinates these are only the readings with a large whitened residual.
    """
    recording = adjustment.recording
    lost = np.isin(recording.targets, adjustment.undetermined_targets)[recording.target]
    is_unconnected = np.isin(recording.targets, adjustment.unconnected_targets)[recording.target]
    return ~is_unconnected[:, None] & (~lost[:, None] | (np.abs(whitened_residuals) > MAX_CHANCE_SIGMAS))


def fit_verdict(adjustment: Adjustment, fit_with_constants: FitWithConstants | None = None) -> Verdict:
    """Verdict on the test to trust, if the tests of an adjustment disagree.

    `fit_with_constants` also estimates the instrument constants; None if there is no such fit. The level is
    `TWO_SIDED_GLOBAL_TEST_LEVEL`.
    """
    return verdict_on(adjustment, TWO_SIDED_GLOBAL_TEST_LEVEL, fit_with_constants)


def noise_rows(adjustment: Adjustment) -> tuple[NoiseRow, ...]:
    """Result rows of the noise that was estimated from the readings, one row per group of readings."""
    problem, recording = adjustment.problem, adjustment.recording
    noise_entries = []
    for c in adjustment.variance_components:
        if c.observable == "level":
            unit, factor, sigmas = "arcsec", ARCSECOND, problem.level_rows.tilt_sigmas
        else:
            column = OBSERVABLES.index(c.observable)
            unit, factor = OBSERVABLE_DISPLAY_UNITS[column]
            names = np.array(recording.instruments)[recording.instrument]
            sigmas = problem.reading_sigmas[
                problem.is_used_reading[:, column] & ((names == c.instrument) | (c.instrument == "")), column
            ]
        if len(sigmas):
            typical = float(np.median(sigmas)) / factor
            noise_entries.append(
                NoiseRow(
                    observable=c.observable,
                    instrument=c.instrument,
                    factor=c.noise_factor,
                    factor_sigma=c.noise_factor_sigma,
                    redundancy=c.redundancy,
                    median_sigma=typical,
                    unit=unit,
                )
            )
    return tuple(noise_entries)


def reference_value_entries(adjustment: Adjustment) -> tuple[ReferenceValueTestEntry, ...]:
    """Entries of reference coordinates, lengths and levels with their tests, one entry per component."""
    value_entries = []
    for test, k in ((each, k) for each in adjustment.reference_tests for k in range(len(each.error))):
        unit, factor = ERROR_UNIT_BY_REFERENCE_KIND.get(test.kind, ("mm", MILLIMETRE))
        is_scalar, is_tested = (
            len(test.error) == 1 and not test.declared_axes,
            bool(np.isfinite(test.error_sigmas[k])),
        )
        entry = ReferenceValueTestEntry(
            kind=test.kind,
            name=test.name,
            component="" if is_scalar else (test.declared_axes or "xy")[k],
            residual=float(test.residual[k]) / factor,
            error=float(test.error[k]) / factor,
            sigma_error=float(test.error_sigmas[k]) / factor if is_tested else None,
            minimal_detectable_error=float(test.minimal_detectable_errors[k]) / factor if is_tested else None,
            unit=unit,
            redundancy=float(test.redundancy[k]),
            w=float(abs(test.error[k]) / test.error_sigmas[k]) if is_tested and test.error_sigmas[k] > 0.0 else 0.0,
            excluded=test.is_excluded,
        )
        value_entries.append(entry)
    return tuple(value_entries)


def axes_entry(adjustment: Adjustment) -> AxesEntry | None:
    """Standard deviations of the axes that declared coordinates define, from their misfit to the network.

    The result is None if `setup.toml` declares no such coordinates.
    """
    accepted_tests = [test for test in adjustment.axes_point_tests if not test.is_excluded]
    if not accepted_tests:
        return None
    places = adjustment.state.target_points[[adjustment.recording.targets.index(test.name) for test in accepted_tests]]
    centre = places.mean(axis=0)
    free = motions_about_centre(adjustment.problem.free_motions, centre)
    motion = rigid_motion_jacobian(places, centre) @ free
    misses = np.concatenate([test.residual for test in accepted_tests])
    variance = float(misses @ misses) / max(len(misses) - free.shape[1], 1)
    sigma = np.sqrt(variance * np.diag(free @ np.linalg.inv(motion.T @ motion) @ free.T))
    return AxesEntry(
        target_names=tuple(test.name for test in accepted_tests),
        sigma_position_mm=(sigma[:3] / MILLIMETRE).tolist(),
        sigma_rotation_arcsec=(sigma[3:] / ARCSECOND).tolist(),
    )


def network_notes(adjustment: Adjustment) -> tuple[str, ...]:
    """Notes for users on an adjusted network: its axes, its range zeros, and a possible mirror image."""
    kinds = (_axes_notes, range_zero_notes, _handedness_notes, _undetermined_height_notes)
    return tuple(note for notes_of in kinds for note in notes_of(adjustment))


def _axes_notes(adjustment: Adjustment) -> tuple[str, ...]:
    """Note for users on how well declared coordinates define the axes; empty unless they define only the axes."""
    fitted = axes_entry(adjustment)
    if fitted is None:
        return ()
    tests = adjustment.axes_point_tests
    within = max(float(np.linalg.norm(test.residual)) for test in tests if not test.is_excluded) / MILLIMETRE
    source = adjustment.recording.setup.datum_source
    place = " ".join(f"{v:.2g}" for v in fitted.sigma_position_mm)
    turn = " ".join(f"{v:.2g}" for v in fitted.sigma_rotation_arcsec)
    sentence = (
        f"coordinates in the axes of {source}: {len(fitted.target_names)} targets fit it within {within:.3g} mm, "
        f"which leaves the axes uncertain by {place} mm (x, y and z at the centroid) and {turn} arcsec (1 sigma)"
    )
    if (scale := scale_error_of_declared_axes(adjustment)) is not None:
        amount = with_sigma(scale[0] / PPM, scale[1] / PPM)
        sentence += f"; the scale of the coordinates differs by {amount} ppm from the measured lengths: check the unit "
        sentence += f"and the temperature of both ({temperature_errors_text(scale[0])})"
    if out := [f"{test.name} ({test.error_text})" for test in tests if test.is_excluded]:
        sentence += f"; excluded from the datum: {names_text(out)}"
    moved = [test.name for test in tests if test.name in moved_target_names(adjustment.effects)]
    return (f"{sentence}. {moved_coordinates_sentence(moved)}" if moved else sentence,)


def frame_text(adjustment: Adjustment) -> str:
    """Description for users of the coordinate frame of an adjusted network."""
    problem, recording = adjustment.problem, adjustment.recording
    free = problem.free_motions.shape[1]
    first_station = recording.stations[0]
    control_rows, flat = (
        problem.control_rows,
        adjustment.is_height_undetermined_target[problem.control_rows.point_indices],
    )
    control = [
        recording.targets[i]
        for i in control_rows.point_indices[control_rows.is_declared_coordinate[:, :2].any(axis=1) | ~flat]
    ]
    control += [problem.marks.mark_names[i] for i in problem.control_rows_of_marks.point_indices]
    levelled = [recording.stations[i] for i in problem.level_rows.station_indices]
    turned = [recording.stations[i] for i in problem.yaw_rows.station_indices]
    zeros = [f"the azimuth zero of {names_text(turned)}"] if turned else []
    zeros += (
        [f"the known differences {names_text(problem.difference_rows.names)}"] if problem.difference_rows.names else []
    )
    points = [f"the control point{'s' if len(control) > 1 else ''} {names_text(control)}"] if control else []
    if free == 0:
        return f"the frame of {' and '.join([*points, *zeros])}"
    definition = f"are defined by {_datum_text(adjustment, first_station)}"
    if adjustment.datum is not None:
        definition += f", standard deviations by inner constraints over {names_text(adjustment.datum.point_names)}"
    if free == 6 or not (points or zeros or not adjustment.is_height_undetermined_target.all()):
        return definition.removeprefix("are defined by ")
    if not control and not problem.difference_rows.names:
        axes = ", x ".join([f"z is defined by the levels of {names_text(levelled)}", *zeros])
        return f"{axes}; the other axes {definition}"
    levels = ["the levels"] if levelled else []
    return f"{' and '.join([*points, *levels, *zeros])}; the remaining free motions {definition}"


def _datum_text(adjustment: Adjustment, station: str) -> str:
    """Text for users on the definition of the datum, which fixes the free motions of the network.

    `station` is the name of the station that defines the datum if nothing else does.
    """
    state, frame = adjustment.state, DeclaredFrame.from_recording(adjustment.recording)
    if adjustment.datum is not None and _has_declared_datum_points(adjustment):
        source = adjustment.recording.setup.datum_source
        axes = (
            "the axes and the scale"
            if len(adjustment.problem.undetermined_unknowns.scale_defining_target)
            else "the axes"
        )
        return f"{axes} of {source}" if source else f"{axes} of the declared coordinates of the datum's targets"
    if adjustment.datum is None and frame.agrees_with_floor_plan(state.station_positions, state.station_rotations):
        return f"the frame of the floor plan, by the approximate positions of the stations, fixed at station {station}"
    return f"the frame of station {station}"


def _has_declared_datum_points(adjustment: Adjustment) -> bool:
    """True if `setup.toml` declares coordinates of targets that define the datum."""
    names = adjustment.datum.point_names if adjustment.datum is not None else ()
    setups = [adjustment.recording.target_setup(name) for name in names]
    return any(s.approximate_mm or s.known_mm for s in setups)


def undetermined_by_instrument(covariance: Floats, prior_sigma: Floats) -> list[list[ParameterCombination]]:
    """Undetermined combinations of parameters of each instrument.

    `covariance` and `prior_sigma` belong to the parameters of all instruments.
    """
    n_instruments, n_parameters = prior_sigma.shape
    if not n_parameters:
        return [[] for _ in range(n_instruments)]
    blocks = covariance.reshape(n_instruments, n_parameters, n_instruments, n_parameters)
    return [undetermined_combinations(blocks[i, :, i], prior_sigma[i]) for i in range(n_instruments)]


def criteria_entry(
    recording: Recording,
    adjustment: Adjustment,
    construction: GeometricErrorModel,
    parameter_values: Floats,
    *,
    corrects_reflectors: bool = True,
) -> CriteriaEntry | None:
    """Disagreement of the stations before and after correction, without excluded pointings; None for a single station.

    The correction with the instrument parameters `parameter_values` [SI] removes the estimated effects and, if
    `corrects_reflectors` is True, the incidence errors of the reflectors, as in `correct`. Other estimated errors
    remain.
    """
    use: Bools = np.asarray(~adjustment.is_rejected_reading.any(axis=1))
    recording = _recording_with_reference_smr(recording, adjustment)
    try:
        if not construction.n_parameters:
            return evaluate_criteria(recording, row_mask=use)
        applied = parameter_values[0] if len(parameter_values) == 1 else parameter_values[recording.instrument]
        model, state = adjustment.problem.model, adjustment.state
        shift = model.change_by_effects(adjustment.sightings, state.extra_parameters)
        if corrects_reflectors and np.any(parameter_values):
            shift += model.change_by_incidence_errors(adjustment.sightings, state.extra_parameters)
        return evaluate_criteria(recording, construction, applied, reading_changes=shift, row_mask=use)
    except NetworkError:
        return None


def _recording_with_reference_smr(recording: Recording, adjustment: Adjustment) -> Recording:
    """Copy of a recording with the ranges that the reference SMR would have given in each pointing."""
    offsets = smr_radius_offsets(recording)
    if offsets is None:
        return recording
    readings = recording.readings + reading_change_by_displacement(adjustment.sightings, -offsets)
    return recording.replace(readings=readings, setup=recording.setup.model_copy(update={"reflectors": {}}))


def _handedness_notes(adjustment: Adjustment) -> tuple[str, ...]:
    """Note for users that a network of ranges alone may be the mirror image of the hall; empty for other networks."""
    recording, state = adjustment.recording, adjustment.state
    if recording.is_measured[:, 1:].any() or adjustment.problem.free_motions.shape[1] == 0:
        return ()
    if DeclaredFrame.from_recording(recording).resolves_mirror(state.station_positions, state.target_points):
        return ()
    return (
        "ranges alone do not distinguish a network from its mirror image; add approximate coordinates of a few targets "
        "and stations that do not lie in one plane (approximate_mm, position_mm)",
    )


def _undetermined_height_notes(adjustment: Adjustment) -> tuple[str, ...]:
    """Note for users on the targets whose height is undetermined; empty without such targets."""
    names = [adjustment.recording.targets[t] for t in np.flatnonzero(adjustment.is_height_undetermined_target)]
    return (f"no reading determines the height of {names_text(names)}: adjusted in plan only",) if names else ()


def range_zero_notes(adjustment: Adjustment) -> tuple[str, ...]:
    """Note for users on the range zeros of interferometer and absolute distance meter; empty unless both were used."""
    if DISTANCE_METER_COLUMN not in adjustment.recording.regressor_covariates:
        return ()
    if not any(isinstance(effect, RangeMode) for effect in adjustment.effects):
        return ("two distance meters were used with one range zero assumed for both; method network estimates both",)
    value, sigma = adjustment.state.extra_parameters[0], np.sqrt(adjustment.effect_covariance[0, 0])
    zero = with_sigma(value / MICROMETRE, sigma / MICROMETRE, "um")
    return (f"the range zero of the interferometer minus that of the absolute distance meter is {zero} (range-mode)",)
