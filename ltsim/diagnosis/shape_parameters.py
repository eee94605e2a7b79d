"""Posterior distribution of the parameters and shape parameters of an effect, on a grid of shape parameters.

A shape parameter enters the effect nonlinearly (period, time constant, onset time). The grid also includes neighbouring
places, such as the time of a step in the next gap between pointings.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import SI_PER_UNIT
from ltsim.diagnosis.evidence import index_of_most_evidence, normalised_probabilities, wide_prior_posterior
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import EffectModel
from ltsim.diagnosis.schema import ParameterEstimate
from ltsim.physics.effects.linear_effect import CandidateEffect, ShapeParameter
from ltsim.scene.sightings import Sightings

REGION_CENTRE_DIFFERENCE_STEP = 0.05
"""Step [m] of the centre of a region of the hall for second differences of the log evidence."""
MAX_CENTRE_SIGMA_IN_STEPS = 20.0
"""Largest standard deviation of a coordinate of a region's centre, divided by `REGION_CENTRE_DIFFERENCE_STEP`. A
coordinate that the readings do not determine gets this standard deviation."""
N_SHAPE_GRID_POINTS = 11
"""Number of grid points in the integral over a shape parameter, from one step below its optimum to one step above
(steps of the grid of values that a diagnosis tries)."""
N_REFINEMENT_GRID_POINTS = 9
"""Number of points of each refinement of the grid of a shape parameter around its optimum. The peak of the evidence may
be much narrower than a step."""
N_GRID_REFINEMENTS = 2
"""Number of refinements of the grid of a shape parameter around its optimum."""


def _shape_parameter_grid(shape: ShapeParameter, estimate: float, sigma: float, n_nodes: int) -> tuple[Floats, Floats]:
    """Grid of q values (q,) of a shape parameter within its bounds, and the widths (q,) of the cells of the grid.

    `shape` defines the shape parameter. The grid has `n_nodes` values over the bounds, and is denser within four
    standard deviations `sigma` of `estimate`. The widths are in the coordinate in which the grid is evenly spaced: the
    value, its logarithm, or its reciprocal.
    """

    def even_coordinate(x: Floats) -> Floats:
        """Coordinate of the values `x` in which the grid is evenly spaced."""
        return np.log(x) if shape.has_logarithmic_grid else (1.0 / x if shape.has_reciprocal_grid else x)

    low, high = min(shape.lower_bound, estimate), max(shape.upper_bound, estimate)
    grid = np.geomspace(low, high, n_nodes) if shape.has_logarithmic_grid else np.linspace(low, high, n_nodes)
    if shape.has_reciprocal_grid:
        grid = 1.0 / np.linspace(1.0 / low, 1.0 / high, n_nodes)
    near = np.clip(estimate + sigma * np.linspace(-4.0, 4.0, 13), low, high)
    grid_values = np.unique(np.concatenate([grid, near, [estimate]]))
    edges = even_coordinate(
        np.concatenate([grid_values[:1], 0.5 * (grid_values[1:] + grid_values[:-1]), grid_values[-1:]])
    )
    return grid_values, np.maximum(np.abs(np.diff(edges)), 1e-300)


def shape_parameter_at_position(shape: ShapeParameter, lower: float, upper: float, position: float) -> float:
    """Value of the shape parameter `shape` at a `position` from -1 at `lower` to 1 at `upper`.

    The value, its logarithm or its reciprocal is a linear function of the position, as on the grid of the parameter.
    """
    s = 0.5 * (position + 1.0)
    if shape.has_logarithmic_grid:
        return float(lower * (upper / lower) ** s)
    if shape.has_reciprocal_grid and lower > 0:
        return float(1.0 / ((1 - s) / lower + s / upper))
    return float(lower + s * (upper - lower))


def integrate_over_shapes(
    calculator: EvidenceCalculator, effect: CandidateEffect, conditioning_model: EffectModel
) -> tuple[CandidateEffect, float]:
    """Effect with the most probable shape parameters, and log evidence averaged over one step of the search grid.

    Shape parameters enter nonlinearly (period, time constant, onset time). The effects of `conditioning_model` are
    estimated in addition.
    """
    effect, value = calculator.refine_locally([effect], conditioning_model)[0]
    for shape in type(effect).shape_parameters:
        now = getattr(effect, shape.name)
        if isinstance(now, float) and shape.n_grid_values > 1:
            effect, value = _integrate_over_shape(calculator, effect, shape, conditioning_model, value)
    return effect, value


def _integrate_over_shape(
    calculator: EvidenceCalculator,
    effect: CandidateEffect,
    shape: ShapeParameter,
    conditioning_model: EffectModel,
    log_evidence: float,
) -> tuple[CandidateEffect, float]:
    """Effect with the most probable value of one shape parameter, and log evidence averaged over a grid cell.

    The cell extends over one step of the grid of the search on both sides. `shape` defines the shape parameter, and
    `log_evidence` is the log evidence of `effect`. The effects of `conditioning_model` are estimated in addition.
    """
    now = float(getattr(effect, shape.name))
    low, high = shape.neighbouring_grid_interval(now)
    if not low < high:
        return effect, log_evidence
    u = np.linspace(-1.0, 1.0, N_SHAPE_GRID_POINTS)

    def log_evidence_at(positions: Floats) -> Floats:
        """Log evidence at positions from -1 to 1: one step of the search grid below and above the effect's value."""
        values = (shape_parameter_at_position(shape, low, high, x) for x in positions.tolist())
        return calculator.log_evidence(
            [effect.with_shape_parameters(**{shape.name: value}) for value in values], conditioning_model
        )

    logs = log_evidence_at(u)
    for _ in range(N_GRID_REFINEMENTS):
        top = index_of_most_evidence(logs)
        near = u[max(top - 1, 0) : top + 2]
        more = np.setdiff1d(np.linspace(near[0], near[-1], N_REFINEMENT_GRID_POINTS), u)
        order = np.argsort(np.concatenate([u, more]))
        u, logs = np.concatenate([u, more])[order], np.concatenate([logs, log_evidence_at(more)])[order]
    best_effect = effect.with_shape_parameters(
        **{shape.name: shape_parameter_at_position(shape, low, high, float(u[index_of_most_evidence(logs)]))}
    )
    height = np.exp(logs - logs.max())
    return best_effect, float(logs.max() + np.log(max(np.trapezoid(height, u), 1e-300)))


def are_distinct(effect: CandidateEffect, other_effect: CandidateEffect) -> bool:
    """True if two effects differ in stations or targets, or in a shape parameter by more than a step of its grid.

    Shape parameters enter nonlinearly (period, time constant, onset time).
    """
    if (effect.stations, effect.targets) != (other_effect.stations, other_effect.targets):
        return True
    for shape in type(effect).shape_parameters:
        low, high = shape.neighbouring_grid_interval(float(vars(other_effect)[shape.name]))
        if not low <= float(vars(effect)[shape.name]) <= high:
            return True
    return False


class ShapeParameterNode(NamedTuple):
    """Node of a grid over the shape parameters of an effect, with the estimates of the k sizes of the effect there."""

    effect: CandidateEffect
    """Effect with the shape parameters of the node."""
    log_weight: float
    """Log of the evidence at the node times the volume of the grid cell around the node."""
    shape_parameters: dict[str, float]
    """Values [SI] of the shape parameters by name, including the time of a change."""
    parameter_means: Floats
    """Posterior mean (k,) [SI] of the k sizes of the effect, given the shape parameters of the node."""
    parameter_variances: Floats
    """Posterior variance (k,) [SI squared] of the k sizes of the effect, given the shape parameters of the node."""
    gap_duration: float
    """Time [s] between the pointings before and after a change, which may have happened at any time in between."""


def _index_and_duration_of_gap(effect: CandidateEffect, sightings: Sightings) -> tuple[int, float]:
    """Index of the gap between pointings in which an effect changes, and duration [s] of the gap.

    Index and duration are -1 and 0 for an effect without a change at one time.
    """
    ordered = np.unique(sightings.time[effect.pointing_indicator(sightings) > 0])
    time = vars(effect).get("time")
    if time is None or not np.isfinite(time) or len(ordered) < 2:
        return -1, 0.0
    after = int(np.searchsorted(ordered, time))
    return after, float(np.diff(ordered)[min(max(after - 1, 0), len(ordered) - 2)])


def _distinct_neighbours(effect: CandidateEffect, sightings: Sightings) -> list[CandidateEffect]:
    """Effect and slightly different effects, one for each place and each gap between consecutive pointings.

    Each gap has then the same weight.
    """
    by_gap = {}
    for instance in [*effect.neighbours(sightings), effect]:
        gap_index, _ = _index_and_duration_of_gap(instance, sightings)
        by_gap[instance.stations, instance.targets, instance if gap_index < 0 else gap_index] = instance
    return list(by_gap.values())


def shape_parameter_nodes(
    calculator: EvidenceCalculator,
    effect: CandidateEffect,
    conditioning_model: EffectModel,
    shape_parameter_sigmas: Mapping[str, float],
    *,
    uses_search_prior: bool = False,
) -> list[ShapeParameterNode]:
    """Nodes of a grid over the shape parameters of an effect, and over slightly different effects.

    The result is empty for an effect without shape parameters and neighbours. The grid is finer around the shape
    parameters of `effect`. `shape_parameter_sigmas` are the standard deviations [SI] of these parameters by name. The
    weights of the nodes use a wide prior of the sizes or, if `uses_search_prior`, the prior of the search. The effects
    of `conditioning_model` are estimated in addition.
    """
    shape_parameters = [
        s for s in type(effect).shape_parameters if isinstance(vars(effect)[s.name], float) and s.n_grid_values > 1
    ]
    near = effect.neighbours(calculator.residual_space.sightings)
    if not (shape_parameters or near) or len(shape_parameters) > 2:
        return []
    n_grid_values = 33 if len(shape_parameters) == 1 and not near else 15
    axes = [
        _shape_parameter_grid(s, float(vars(effect)[s.name]), shape_parameter_sigmas.get(s.name, 0.0), n_grid_values)
        for s in shape_parameters
    ]
    plausible_sizes = effect.plausible_sizes
    sightings = calculator.residual_space.sightings
    points = [
        (
            instance,
            {s.name: float(value) for s, (value, _) in zip(shape_parameters, point, strict=True)},
            [w for _, w in point],
        )
        for instance, *point in product(
            _distinct_neighbours(effect, sightings), *(zip(*axis, strict=True) for axis in axes)
        )
    ]
    grid_effects = [instance.with_shape_parameters(**constants) for instance, constants, _ in points]
    posteriors = [
        wide_prior_posterior(*moments, plausible_sizes)
        for moments in calculator.grams_and_scores(grid_effects, conditioning_model)
    ]
    log_evidences = (
        calculator.log_evidence(grid_effects, conditioning_model).tolist()
        if uses_search_prior
        else [evidence for _, _, evidence in posteriors]
    )
    nodes = []
    for (instance, constants, widths), shape, (mean, covariance, _), evidence in zip(
        points, grid_effects, posteriors, log_evidences, strict=True
    ):
        constants |= {"time": float(vars(instance)["time"])} if "time" in vars(effect) else {}
        _, gap_duration = _index_and_duration_of_gap(instance, sightings)
        weight = evidence + float(np.sum(np.log(widths))) + (np.log(gap_duration) if gap_duration else 0.0)
        nodes.append(ShapeParameterNode(shape, weight, constants, mean, np.diag(covariance), gap_duration))
    return nodes


def region_centre_estimates(
    calculator: EvidenceCalculator, effect: CandidateEffect, conditioning_model: EffectModel
) -> tuple[ParameterEstimate, ...]:
    """Estimated coordinates, in the network frame, of the centre of the region of an effect; empty without a region.

    The covariance is the inverse of the negative second differences of the log evidence at the centre (Laplace
    approximation). A coordinate that the readings do not determine has a standard deviation of 1 m.
    """
    centre = np.array(effect.region_centre)
    if not len(centre):
        return ()
    k = len(centre)
    steps = REGION_CENTRE_DIFFERENCE_STEP * np.eye(k)
    moves = [np.zeros(k), *steps, *-steps]
    axis_pairs = list(combinations(range(k), 2))
    moves += [steps[i] + steps[j] for i, j in axis_pairs] + [steps[i] - steps[j] for i, j in axis_pairs]
    moves += [steps[j] - steps[i] for i, j in axis_pairs] + [-steps[i] - steps[j] for i, j in axis_pairs]
    log_evidences = calculator.log_evidence(
        [effect.centred_at(tuple((centre + move).tolist())) for move in moves], conditioning_model
    )
    ahead, behind, crossed = (
        log_evidences[1 : k + 1],
        log_evidences[k + 1 : 2 * k + 1],
        log_evidences[2 * k + 1 :].reshape(4, -1),
    )
    hessian = np.diag((2.0 * log_evidences[0] - ahead - behind) / REGION_CENTRE_DIFFERENCE_STEP**2)
    mixed = -(crossed[0] - crossed[1] - crossed[2] + crossed[3]) / (4.0 * REGION_CENTRE_DIFFERENCE_STEP**2)
    for (i, j), value in zip(axis_pairs, mixed, strict=True):
        hessian[i, j] = hessian[j, i] = value
    eigenvalues, eigenvectors = np.linalg.eigh(hessian)
    variance = eigenvectors**2 @ (
        1.0 / np.maximum(eigenvalues, 1.0 / (MAX_CENTRE_SIGMA_IN_STEPS * REGION_CENTRE_DIFFERENCE_STEP) ** 2)
    )
    return tuple(
        ParameterEstimate(name=f"centre-{axis}", value=float(value), sigma=float(np.sqrt(v)), unit="m")
        for axis, value, v in zip(effect.region_centre_axes, centre, variance, strict=True)
    )


def estimates_averaged_over_shapes(
    calculator: EvidenceCalculator,
    effect: CandidateEffect,
    conditioning_model: EffectModel,
    estimates: Sequence[ParameterEstimate],
) -> dict[str, ParameterEstimate]:
    """Posterior means and standard deviations of the parameters and shape parameters of an effect, by name.

    The posterior is summed over a grid of shape parameters that is densest at `estimates`. Unlike the Laplace
    approximation, the results are valid for flat, skew, bounded and bimodal likelihoods. The result is empty for
    effects without shape parameters. The effects of `conditioning_model` are estimated in addition.
    """
    nodes = shape_parameter_nodes(
        calculator, effect, conditioning_model, {e.name: e.sigma * SI_PER_UNIT[e.unit] for e in estimates}
    )
    if not nodes:
        return {}
    weight = normalised_probabilities(np.array([node.log_weight for node in nodes]))
    node_values = np.array([[*node.parameter_means, *node.shape_parameters.values()] for node in nodes])
    within = np.array(
        [
            [*s.parameter_variances, *((name == "time") * s.gap_duration**2 / 12.0 for name in s.shape_parameters)]
            for s in nodes
        ]
    )
    posterior_mean = weight @ node_values
    sigma = np.sqrt(np.maximum(weight @ (within + node_values**2) - posterior_mean**2, 0.0))
    units = (
        {"time": "s"}
        | {s.name: s.unit for s in type(effect).shape_parameters}
        | {p.name: p.unit for p in effect.parameters}
    )
    names = [*(p.name for p in effect.parameters), *nodes[0].shape_parameters]
    return {
        name: ParameterEstimate(
            name=name, value=m / SI_PER_UNIT[units[name]], sigma=d / SI_PER_UNIT[units[name]], unit=units[name]
        )
        for name, m, d in zip(names, posterior_mean, sigma, strict=True)
    }
