"""Posterior of the parameters and shape constants of an effect, over all its shapes and neighbouring places.

A shape constant is a constant on which the effect does not depend linearly, such as a time constant.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import SI_PER_UNIT
from ltsim.diagnosis.evidence import normalised_probabilities, wide_prior_posterior
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import Model
from ltsim.diagnosis.schema import ParameterEstimate
from ltsim.physics.effects.linear_effect import CandidateEffect, ShapeParameter
from ltsim.scene.sightings import Sightings

PLACE_DIFFERENCE_STEP = 0.05
"""Step [m] of the second differences of the log evidence over the position of a region of the hall."""
UNBOUNDED_STEP_FACTOR = 20.0
"""Standard deviation of a coordinate that the readings do not determine, as a multiple of `PLACE_DIFFERENCE_STEP`."""


def _dense_grid(shape: ShapeParameter, estimate: float, sigma: float, n_nodes: int) -> tuple[Floats, Floats]:
    """Grid of values (q,) of a shape constant within its bounds, and the widths (q,) of the cells of the grid.

    The grid has `n_nodes` values over the bounds, and is denser within four standard deviations `sigma` of `estimate`.
    The widths are in the coordinate in which the grid is even: the value, its logarithm, or its reciprocal.
    """

    def evenly_spaced(x: Floats) -> Floats:
        return np.log(x) if shape.has_logarithmic_grid else (1.0 / x if shape.has_reciprocal_grid else x)

    low, high = min(shape.lower_bound, estimate), max(shape.upper_bound, estimate)
    grid = np.geomspace(low, high, n_nodes) if shape.has_logarithmic_grid else np.linspace(low, high, n_nodes)
    if shape.has_reciprocal_grid:
        grid = 1.0 / np.linspace(1.0 / low, 1.0 / high, n_nodes)
    near = np.clip(estimate + sigma * np.linspace(-4.0, 4.0, 13), low, high)
    grid_values = np.unique(np.concatenate([grid, near, [estimate]]))
    edges = evenly_spaced(
        np.concatenate([grid_values[:1], 0.5 * (grid_values[1:] + grid_values[:-1]), grid_values[-1:]])
    )
    return grid_values, np.maximum(np.abs(np.diff(edges)), 1e-300)


def interpolate_shape(shape: ShapeParameter, lower: float, upper: float, position: float) -> float:
    """Value of a shape constant at a `position` from -1 at `lower` to 1 at `upper`.

    The value, its logarithm or its reciprocal is a linear function of the position, as on the grid of the constant.
    """
    s = 0.5 * (position + 1.0)
    if shape.has_logarithmic_grid:
        return float(lower * (upper / lower) ** s)
    if shape.has_reciprocal_grid and lower > 0:
        return float(1.0 / ((1 - s) / lower + s / upper))
    return float(lower + s * (upper - lower))


def are_distinct(effect: CandidateEffect, other_effect: CandidateEffect) -> bool:
    """True if two effects differ in place, or in a shape constant by more than the range of the integration over it."""
    if (effect.stations, effect.targets) != (other_effect.stations, other_effect.targets):
        return True
    for shape in type(effect).shape_parameters:
        low, high = shape.neighbouring_grid_interval(float(vars(other_effect)[shape.name]))
        if not low <= float(vars(effect)[shape.name]) <= high:
            return True
    return False


class ShapeConstantsNode(NamedTuple):
    """Node of the grid of shape constants of an effect: a value of each, and estimates of the k parameters."""

    effect: CandidateEffect
    """Effect with these shape constants."""
    log_weight: float
    """Log of the evidence times the volume of the node's cell."""
    constants: dict[str, float]
    """Shape constants by name [SI], with the time of a change."""
    mean: Floats
    """Posterior mean (k,) of the parameters [SI]."""
    variance: Floats
    """Posterior variance (k,) of the parameters [SI]."""
    gap: float
    """Time [s] between the pointings before and after a change, which may be at any time in between."""


def _gap_of_change(effect: CandidateEffect, sightings: Sightings) -> tuple[int, float]:
    """Number of the gap between pointings in which an effect changes, and its width [s]; -1 and 0 without a change."""
    ordered = np.unique(sightings.time[effect.row_weights(sightings) > 0])
    time = vars(effect).get("time")
    if time is None or not np.isfinite(time) or len(ordered) < 2:
        return -1, 0.0
    after = int(np.searchsorted(ordered, time))
    return after, float(np.diff(ordered)[min(max(after - 1, 0), len(ordered) - 2)])


def _distinct_neighbours(effect: CandidateEffect, sightings: Sightings) -> list[CandidateEffect]:
    """Effect and its neighbours, one for each place and gap, so that no gap has twice the weight."""
    by_gap = {}
    for instance in [*effect.neighbours(sightings), effect]:
        gap, _ = _gap_of_change(instance, sightings)
        by_gap[instance.stations, instance.targets, instance if gap < 0 else gap] = instance
    return list(by_gap.values())


def shape_constants_nodes(
    calculator: EvidenceCalculator,
    effect: CandidateEffect,
    base_model: Model,
    shape_sigmas: Mapping[str, float],
    *,
    within_plausible: bool = False,
) -> list[ShapeConstantsNode]:
    """Nodes of the grid of an effect over its shape constants and neighbouring places; empty if it has neither.

    The grid is finer around the shape constants of `effect`. `shape_sigmas` are the standard deviations [SI] of these
    constants by name. The weights of the nodes use a wide prior of the sizes or, if `within_plausible`, the prior that
    the search uses.
    """
    shape_parameters = [
        s for s in type(effect).shape_parameters if isinstance(vars(effect)[s.name], float) and s.n_grid_values > 1
    ]
    near = effect.neighbours(calculator.space.sightings)
    if not (shape_parameters or near) or len(shape_parameters) > 2:
        return []
    n_grid_values = 33 if len(shape_parameters) == 1 and not near else 15
    axes = [
        _dense_grid(s, float(vars(effect)[s.name]), shape_sigmas.get(s.name, 0.0), n_grid_values)
        for s in shape_parameters
    ]
    size_scales = effect.size_scales
    sightings = calculator.space.sightings
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
    grid_effects = [instance.with_constants(**constants) for instance, constants, _ in points]
    posteriors = [
        wide_prior_posterior(*moments, size_scales) for moments in calculator.gram_and_score(grid_effects, base_model)
    ]
    log_evidences = (
        calculator.log_evidence(grid_effects, base_model).tolist()
        if within_plausible
        else [evidence for _, _, evidence in posteriors]
    )
    nodes = []
    for (instance, constants, widths), shape, (mean, covariance, _), evidence in zip(
        points, grid_effects, posteriors, log_evidences, strict=True
    ):
        constants |= {"time": float(vars(instance)["time"])} if "time" in vars(effect) else {}
        _, gap = _gap_of_change(instance, sightings)
        weight = evidence + float(np.sum(np.log(widths))) + (np.log(gap) if gap else 0.0)
        nodes.append(ShapeConstantsNode(shape, weight, constants, mean, np.diag(covariance), gap))
    return nodes


def centre_estimates(
    calculator: EvidenceCalculator, effect: CandidateEffect, base_model: Model
) -> tuple[ParameterEstimate, ...]:
    """Coordinates in the network frame of the centre of a region of the hall; empty for effects without a region.

    The covariance is the inverse of the negative second differences of the log evidence at the centre (Laplace
    approximation). A coordinate that the readings do not determine has a standard deviation of 1 m.
    """
    centre = np.array(effect.source_position)
    if not len(centre):
        return ()
    k = len(centre)
    steps = PLACE_DIFFERENCE_STEP * np.eye(k)
    moves = [np.zeros(k), *steps, *-steps]
    axis_pairs = list(combinations(range(k), 2))
    moves += [steps[i] + steps[j] for i, j in axis_pairs] + [steps[i] - steps[j] for i, j in axis_pairs]
    moves += [steps[j] - steps[i] for i, j in axis_pairs] + [-steps[i] - steps[j] for i, j in axis_pairs]
    log_evidences = calculator.log_evidence(
        [effect.centred_at(tuple((centre + move).tolist())) for move in moves], base_model
    )
    ahead, behind, crossed = (
        log_evidences[1 : k + 1],
        log_evidences[k + 1 : 2 * k + 1],
        log_evidences[2 * k + 1 :].reshape(4, -1),
    )
    hessian = np.diag((2.0 * log_evidences[0] - ahead - behind) / PLACE_DIFFERENCE_STEP**2)
    mixed = -(crossed[0] - crossed[1] - crossed[2] + crossed[3]) / (4.0 * PLACE_DIFFERENCE_STEP**2)
    for (i, j), value in zip(axis_pairs, mixed, strict=True):
        hessian[i, j] = hessian[j, i] = value
    eigenvalues, eigenvectors = np.linalg.eigh(hessian)
    variance = eigenvectors**2 @ (
        1.0 / np.maximum(eigenvalues, 1.0 / (UNBOUNDED_STEP_FACTOR * PLACE_DIFFERENCE_STEP) ** 2)
    )
    return tuple(
        ParameterEstimate(name=f"centre-{axis}", value=float(value), sigma=float(np.sqrt(v)), unit="m")
        for axis, value, v in zip(effect.source_position_axes, centre, variance, strict=True)
    )


def shape_posterior(
    calculator: EvidenceCalculator, effect: CandidateEffect, base_model: Model, estimates: Sequence[ParameterEstimate]
) -> dict[str, ParameterEstimate]:
    """Posterior means and standard deviations of the parameters and shape constants of an effect, by name.

    They are averages over a grid of shape constants that is densest at `estimates`. Unlike the Laplace approximation
    they are valid for flat, skew, bounded and bimodal likelihoods. The result is empty for effects without shape
    constants.
    """
    nodes = shape_constants_nodes(
        calculator, effect, base_model, {e.name: e.sigma * SI_PER_UNIT[e.unit] for e in estimates}
    )
    if not nodes:
        return {}
    weight = normalised_probabilities(np.array([node.log_weight for node in nodes]))
    node_values = np.array([[*node.mean, *node.constants.values()] for node in nodes])
    within = np.array([[*s.variance, *((name == "time") * s.gap**2 / 12.0 for name in s.constants)] for s in nodes])
    posterior_mean = weight @ node_values
    sigma = np.sqrt(np.maximum(weight @ (within + node_values**2) - posterior_mean**2, 0.0))
    units = (
        {"time": "s"}
        | {s.name: s.unit for s in type(effect).shape_parameters}
        | {p.name: p.unit for p in effect.parameters}
    )
    names = [*(p.name for p in effect.parameters), *nodes[0].constants]
    return {
        name: ParameterEstimate(
            name=name, value=m / SI_PER_UNIT[units[name]], sigma=d / SI_PER_UNIT[units[name]], unit=units[name]
        )
        for name, m, d in zip(names, posterior_mean, sigma, strict=True)
    }
