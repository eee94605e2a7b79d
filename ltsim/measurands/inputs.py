"""Input quantities of tasks: adjusted points, and all sources of their uncertainty.

To first order, the matrix P = N^-1 A' maps changes of the whitened readings to displacements of the adjusted points; N
is the normal matrix and A the design matrix. Errors of observations, and effects that change readings, displace the
points through P. The covariance of the points is therefore the sum of the contributions of the sources.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np

from ltsim.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import (
    displacement_per_observation,
    displacements_by_air_error,
    displacements_by_shared_air_error,
    longest_range,
    relevant_air_uncertainty,
)
from ltsim.calibration.identified_network import IdentifiedNetwork
from ltsim.core.arrays import Floats, Ints
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import InputError, ModelError, unknown_name_error
from ltsim.core.units import MILLIMETRE
from ltsim.measurands.spec import Tasks, TypeBEffect
from ltsim.physics.effects.air import air_uncertainty_text
from ltsim.physics.effects.air_gradient import AirGradient
from ltsim.physics.effects.effect import Effect, NoiseEffect, design_from_displacements
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.effects.verbs import make_effect
from ltsim.physics.model.construction import declared_construction, ideal_construction
from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.epoch_coordinates import EpochCoordinates
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.recordings.reflectors import smr_names

SIGMA_PER_SIZE_BY_DISTRIBUTION = {
    "normal": 1.0,
    "rectangular": 1 / np.sqrt(3),
    "triangular": 1 / np.sqrt(6),
    "arcsine": 1 / np.sqrt(2),
}
"""Standard deviation of a distribution of size 1, by name of the distribution. The size of a normal distribution is its
standard deviation, the size of each other distribution its half-width."""


REFERENCE_LENGTHS_SOURCE_NAME = "known lengths"
"""Name, in budgets, of the uncertainty that comes from declared reference lengths."""
CONTROL_POINTS_SOURCE_NAME = "control points"
"""Name, in budgets, of the uncertainty that comes from the coordinates of control points."""
PRIOR_SOURCE_NAME = "specification"
"""Name, in budgets, of the uncertainty that comes from the specification of the instrument (prior of its
parameters)."""
CORRECTED_ERRORS_SOURCE_NAME = "plausible size of corrected errors"
"""Name, in budgets, of the uncertainty that comes from errors of the recording which the model corrects with a weak
prior."""
RANDOM_STREAM_KEY_BY_SOURCE = {PRIOR_SOURCE_NAME: "what the maker guarantees"}
"""Key of the random stream of each source of uncertainty whose key differs from its name. The random draws depend on
the key, so that a change of the key would change results."""


@dataclass(frozen=True)
class UncertaintySource(ValueEquality):
    """Source of uncertainty of points: independent random variables, each of which displaces the points."""

    name: str
    """Name of the source in the budget."""
    evaluation_type: Literal["A", "B"]
    """Type of evaluation (GUM): ``A`` for observations, ``B`` for specifications, certificates and all other sources.
    """
    displacements_per_sigma: Floats
    """Displacement of all coordinates by one standard deviation of each random variable, shape (coordinates, random
    variables) [m]."""
    distribution: str = "normal"
    """Distribution of each random variable: `normal`, `rectangular`, `triangular` or `arcsine`."""

    @property
    def covariance(self) -> Floats:
        """Contribution of this source to the covariance of the coordinates, (coordinates, coordinates) [m^2]."""
        return self.displacements_per_sigma @ self.displacements_per_sigma.T


@dataclass(frozen=True)
class TaskInputs(ValueEquality):
    """Points that tasks (measurands such as a length or a circle) use, with the sources of their uncertainty."""

    network_or_coordinates: Adjustment | EpochCoordinates
    """Adjusted network of a recording, or list of coordinates with its covariance."""
    target_names: tuple[str, ...]
    """Names of the points that the tasks use."""
    points: Floats
    """Coordinates of the points, shape (points, 3) [m]."""
    displacement_per_observation: Floats
    """Displacement of all coordinates by a unit of each whitened observation, shape (observations, coordinates) [m]."""
    sources: tuple[UncertaintySource, ...]
    """Sources of uncertainty of the points."""
    air_text: str = ""
    """Phrase on the errors of the air that are among the sources; empty if errors of the air are negligible (short
    ranges)."""
    displacements_by_shared_air_error: dict[str, Floats] = field(default_factory=dict)
    """Displacement (coordinates,) [m] of the points by one standard deviation of each error of the air that all
    stations share and that changes no residual, by description of the error. `sources` do not include these errors."""
    network: IdentifiedNetwork | None = None
    """Adjusted network with the identified causes of its misfit; None for a list of coordinates."""

    @classmethod
    def from_recording(cls, recording: Recording, tasks: Tasks) -> Self:
        """Points that tasks use, from the adjustment of a recording, with the sources of their uncertainty.

        Raises NetworkError or ConvergenceError if the network cannot be solved, ModelError or InputError for an unknown
        target or effect.
        """
        construction = declared_construction(recording) if tasks.calibrate else ideal_construction()
        network = IdentifiedNetwork.from_recording(
            recording, construction, robust=tasks.robust, datum_names=tasks.datum or None
        )
        adjustment, factor = network.adjustment, network.uncertainty_factor
        names = _target_names(tasks)
        for name in names:
            if name not in recording.targets:
                raise unknown_name_error("target", name, recording.targets)
            if name in adjustment.undetermined_targets:
                raise ModelError(f"the readings do not determine target {name}, which a task uses")
        indices = np.array([recording.targets.index(name) for name in names])
        reach = displacement_per_observation(adjustment, adjustment.problem.unknowns.target_columns[indices].ravel())
        observed = [
            replace(s, displacements_per_sigma=factor * _with_fewer_variables(s.displacements_per_sigma))
            for s in observation_uncertainty_sources(adjustment, reach)
        ]
        observed += smr_radius_uncertainty_sources(adjustment, reach)
        further = [_type_b_source(adjustment, reach, entry, i + 1) for i, entry in enumerate(tasks.type_b)]
        air = _air_uncertainty_without_declared_effects(tasks, adjustment)
        counted = relevant_air_uncertainty(adjustment, air)
        further += air_uncertainty_sources(adjustment, reach, counted) if counted else []
        words = air_uncertainty_text(counted, longest_range(adjustment)) if counted else ""
        hidden = displacements_by_shared_air_error(adjustment, reach, air)
        points, sources = adjustment.state.target_points[indices], (*observed, *further)
        return cls(adjustment, names, points, reach, sources, words, hidden, network)

    @classmethod
    def from_coordinates(cls, coordinates: EpochCoordinates, tasks: Tasks) -> Self:
        """Points of the tasks from a list of coordinates, whose joint covariance is the only source of uncertainty.

        Raises ModelError if the list lacks points or axes, and for effects that act on readings.
        """
        if tasks.type_b:
            raise ModelError("type_b acts on readings, and a list of coordinates has none; give the recording")
        if len(coordinates.axes) < 3:
            raise ModelError(f"the list has only {coordinates.axes}, but tasks need x, y and z")
        names = _target_names(tasks)
        for name in names:
            if name not in coordinates.names:
                raise unknown_name_error("target", name, coordinates.names)
        indices = np.array([coordinates.names.index(name) for name in names])
        row_indices = (3 * indices[:, None] + np.arange(3)).ravel()
        values, vectors = np.linalg.eigh(coordinates.covariance[np.ix_(row_indices, row_indices)])
        reach = (vectors * np.sqrt(np.maximum(values, 0.0))).T
        source = UncertaintySource(f"coordinates of {coordinates.title}", "A", reach.T)
        return cls(coordinates, names, coordinates.points[indices], reach, (source,))

    @property
    def covariance(self) -> Floats:
        """Covariance of the coordinates of the points from all sources, shape (coordinates, coordinates) [m^2]."""
        return np.sum([source.covariance for source in self.sources], axis=0)


def _target_names(tasks: Tasks) -> tuple[str, ...]:
    """Names of the points that the tasks use, each name once."""
    return tuple(dict.fromkeys(name for task in tasks.task for name in task.targets))


def observation_uncertainty_sources(adjustment: Adjustment, point_derivatives: Floats) -> list[UncertaintySource]:
    """Sources of uncertainty from each group of observations, except observations that only define the frame.

    `point_derivatives` (observations, coordinates) [m] are the derivatives of the coordinates by the whitened
    observations. Errors that reference lengths share (expansion coefficient, thermometer) are separate sources. Errors
    that the adjustment estimates with a prior (of tracker heads, reflectors, groups of readings) are separate sources
    too.
    """
    problem = adjustment.problem
    observable = np.nonzero(problem.is_used_reading)[1]
    groups = [(f"{name} readings", np.flatnonzero(observable == i)) for i, name in enumerate(OBSERVABLES)]
    gauge, at = problem.gauge_rows, len(observable)
    by_length = point_derivatives[at : at + len(gauge)].T
    at += len(gauge)
    for name, count in (
        (CONTROL_POINTS_SOURCE_NAME, problem.control_rows.n_coordinates + problem.control_rows_of_marks.n_coordinates),
        ("known differences", problem.difference_rows.n_coordinates),
        ("levels", 2 * len(problem.level_rows)),
        ("orientations", len(problem.yaw_rows)),
        ("", problem.undetermined_unknowns.n_fixing_equations),
        (PRIOR_SOURCE_NAME, int(np.isfinite(problem.prior.sigma).sum())),
    ):
        groups.append((name, np.arange(at, at + count)))
        at += count
    sources = [
        UncertaintySource(name, "B" if name == PRIOR_SOURCE_NAME else "A", point_derivatives[rows].T)
        for name, rows in groups
        if name and len(rows)
    ]
    if len(gauge):
        lengths = UncertaintySource(
            REFERENCE_LENGTHS_SOURCE_NAME, "B", by_length @ gauge.decorrelate(np.diag(gauge.certificate_sigmas))
        )
        sources.insert(sum(len(rows) > 0 for _, rows in groups[: len(OBSERVABLES)]), lengths)
    shared = ((name, by_length @ gauge.decorrelate(change)) for name, change in gauge.shared_error_shifts.items())
    sources += [UncertaintySource(name, "B", response[:, None]) for name, response in shared]
    return [*sources, *_nuisance_sources(adjustment, point_derivatives[at:])]


def _nuisance_sources(adjustment: Adjustment, point_derivatives: Floats) -> list[UncertaintySource]:
    """Sources of uncertainty, one per kind of error, from errors that the adjustment estimates with a prior.

    `point_derivatives` (errors, coordinates) [m] are the derivatives of the coordinates by the whitened prior values of
    these errors. The first errors are those of additional effects that the model corrects.
    """
    model = adjustment.problem.model
    finite = np.isfinite(adjustment.problem.effect_prior_sigmas[: model.n_effect_parameters])
    at, reached = int(finite.sum()), dict[str, list[Floats]]()
    if at:
        reached[CORRECTED_ERRORS_SOURCE_NAME] = [point_derivatives[:at].T]
    for error in model.nuisance_errors:
        count = len(error.parameters)
        reached.setdefault(error.parameters[0].description, []).append(point_derivatives[at : at + count].T)
        at += count
    return [UncertaintySource(name, "B", np.concatenate(parts, axis=1)) for name, parts in reached.items()]


def smr_radius_uncertainty_sources(adjustment: Adjustment, point_derivatives: Floats) -> list[UncertaintySource]:
    """Sources of uncertainty from the radii of SMRs with a declared standard deviation, one for each SMR.

    All pointings with an SMR share the error of its radius, which acts along the normals of the nests.
    `point_derivatives` (observations, coordinates) [m] are the derivatives of the coordinates by the whitened
    observations.
    """
    problem, sightings, names = adjustment.problem, adjustment.sightings, np.array(smr_names(adjustment.recording))
    rows, columns = np.nonzero(problem.is_used_reading)
    normal = np.nan_to_num(sightings.nest_normals)[sightings.target]
    sources = []
    for name, reflector in adjustment.recording.setup.reflectors.items():
        off = normal * ((names == name) * (reflector.sigma_radius_mm or 0.0) * MILLIMETRE)[:, None]
        if np.any(off):
            change = (
                design_from_displacements(sightings, off[:, :, None])[rows, columns, 0]
                / problem.reading_sigmas[rows, columns]
            )
            sources.append(
                UncertaintySource(f"radius of {name}", "B", (point_derivatives[: len(rows)].T @ change)[:, None])
            )
    return sources


def _air_uncertainty_without_declared_effects(tasks: Tasks, adjustment: Adjustment) -> AirUncertainty:
    """Uncertainty of the air for a budget, without the properties that a type B effect of the task file describes."""
    declared_effects = {entry.effect for entry in tasks.type_b}
    effects = {"temperature_k": StationWeather.name, "gradient_k_per_m": AirGradient.name}
    air = tasks.air or adjustment.recording.setup.air or AirUncertainty()
    return air.model_copy(update={size: 0.0 for size, effect in effects.items() if effect in declared_effects})


def air_uncertainty_sources(
    adjustment: Adjustment, point_derivatives: Floats, air_uncertainty: AirUncertainty
) -> list[UncertaintySource]:
    """Sources of uncertainty from the unmeasured air: temperature and gradient at each station, and turbulence.

    `point_derivatives` (observations, coordinates) [m] are the derivatives of the coordinates by the whitened
    observations.
    """
    responses = displacements_by_air_error(adjustment, point_derivatives, air_uncertainty)
    return [UncertaintySource(name, "B", _with_fewer_variables(response)) for name, response in responses.items()]


def _with_fewer_variables(displacements_per_variable: Floats) -> Floats:
    """Displacements with the same covariance by fewer random variables: at most as many as there are coordinates.

    `displacements_per_variable` (coordinates, random variables) holds the displacements [m] by one standard deviation
    of each random variable.
    """
    if displacements_per_variable.shape[1] <= displacements_per_variable.shape[0]:
        return displacements_per_variable
    return np.asarray(np.linalg.qr(displacements_per_variable.T, mode="r")).T


def _type_b_source(
    adjustment: Adjustment, point_derivatives: Floats, type_b_entry: TypeBEffect, entry_number: int
) -> UncertaintySource:
    """Source of uncertainty from an effect of the task file (type B); raises InputError for an invalid entry.

    `point_derivatives` (observations, coordinates) [m] are the derivatives of the coordinates by the whitened
    observations. `entry_number` counts the entries of the task file from 1.
    """
    effect, sizes = _effect_and_sizes(adjustment.recording, type_b_entry, entry_number)
    sigma = sizes * SIGMA_PER_SIZE_BY_DISTRIBUTION[type_b_entry.distribution]
    problem = adjustment.problem
    rows, columns = np.nonzero(problem.is_used_reading)
    design = (effect.design(adjustment.sightings) * sigma)[rows, columns]
    whitened_design = design / problem.reading_sigmas[rows, columns][:, None]
    group = _group_of_pointing(adjustment.recording, type_b_entry.draw_shared_by)[rows]
    response = np.zeros((point_derivatives.shape[1], int(group.max(initial=0)) + 1, design.shape[1]))
    for g in np.unique(group):
        mine = np.flatnonzero(group == g)
        response[:, g] = point_derivatives[mine].T @ whitened_design[mine]
    gauge = problem.gauge_rows
    lengths = effect.gauge_design(gauge.first_targets, gauge.second_targets, adjustment.state.target_points) * sigma
    if np.any(lengths):
        if type_b_entry.draw_shared_by != "all":
            key, effect_name = f"type_b.{entry_number}.draw_shared_by", type_b_entry.effect
            raise InputError(f'{key} must be "all" for {effect_name}, because it changes reference lengths')
        response[:, 0] += point_derivatives[len(rows) : len(rows) + len(gauge)].T @ gauge.decorrelate(lengths)
    if not np.any(response):
        raise InputError(f"type_b.{entry_number}: {type_b_entry.effect} acts on no reading that the tasks depend on")
    place = ", ".join(type_b_entry.stations + type_b_entry.targets)
    name = type_b_entry.name or (f"{type_b_entry.effect} at {place}" if place else type_b_entry.effect)
    return UncertaintySource(name, "B", response.reshape(len(response), -1), type_b_entry.distribution)


def _effect_and_sizes(recording: Recording, type_b_entry: TypeBEffect, entry_number: int) -> tuple[Effect, Floats]:
    """Effect of an entry of the task file, and size (parameters,) [SI] of each of its parameters.

    The size is the standard deviation of a normal distribution, or the half-width of another distribution.
    """
    try:
        effect = make_effect(
            type_b_entry.effect,
            {"stations": type_b_entry.stations, "targets": type_b_entry.targets},
            type_b_entry.shape,
        )
    except ModelError as problem:
        raise InputError(f"type_b.{entry_number}: {problem}") from None
    if isinstance(effect, NoiseEffect):
        raise InputError(
            f"type_b.{entry_number}: {type_b_entry.effect} changes the noise; declare it as the instrument's noise"
        )
    for what, wanted, choices in (
        ("station", type_b_entry.stations, recording.stations),
        ("target", type_b_entry.targets, recording.targets),
    ):
        unknown_names = [name for name in wanted if name not in choices]
        if unknown_names:
            raise InputError(f"type_b.{entry_number}.{what}s: {unknown_name_error(what, unknown_names[0], choices)}")
    parameter_names = [p.name for p in effect.parameters]
    unknown_parameters = [name for name in type_b_entry.sizes if name not in parameter_names]
    if unknown_parameters:
        raise InputError(
            f"type_b.{entry_number}.sizes: {unknown_name_error('parameter', unknown_parameters[0], parameter_names)}"
        )
    if not type_b_entry.sizes:
        return effect, np.array([p.prior_sigma for p in effect.parameters])
    return effect, np.array([type_b_entry.sizes.get(p.name, 0.0) * p.si_per_display_unit for p in effect.parameters])


def _group_of_pointing(recording: Recording, draw_scope: str) -> Ints:
    """Group number (pointings,) of each pointing; the pointings of a group share one random draw.

    `draw_scope` is the entry `draw_shared_by` of the task file: `all`, `station`, `instrument`, `target` or `pointing`.
    """
    return {
        "all": np.zeros(len(recording), dtype=np.int64),
        "station": recording.station,
        "instrument": recording.instrument,
        "target": recording.target,
        "pointing": np.arange(len(recording)),
    }[draw_scope]
