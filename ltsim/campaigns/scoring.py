"""What a calibration says of a known truth: its errors over its stated sigmas, and what is to be expected of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ltsim.arrays import Floats
from ltsim.calibration import Calibration
from ltsim.campaigns.foreign import Estimate
from ltsim.errors import SetupError
from ltsim.simulation.truth import Truth
from ltsim.units import FACTOR

NOISELESS = 1e-4
"""Share of a stated variance under which the error is the prior's, not the noise's."""


@dataclass(frozen=True)
class Network:
    """What a trial says of the whole network; NaN where it is not known."""

    targets: float = np.nan
    stations: float = np.nan
    """Mean square of the errors over sigma of all target coordinates, and of all poses but the first station's."""
    chi2: float = np.nan
    dof: float = np.nan
    expected: float = np.nan
    spread: float = np.nan
    """Mean and standard deviation of chi-square for the truth as it was made, stated or drawn."""


@dataclass(frozen=True)
class Trial:
    """What a calibrator found in one trial; parameters in the units that people read."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    estimate: Floats
    sigma: Floats
    """(p,): stated; NaN for none."""
    truth: Floats
    standard: Floats
    """(p,): z-scores that are standard normal for the truth as it was made, stated or drawn; NaN where noise has no
    part, or the calibrator's prior is not known.
    """
    network: Network = Network()
    other: Trial | None = None
    """What ltsim's own calibrator found in the same recording."""

    @property
    def z(self) -> Floats:
        """(p,): errors over stated sigmas."""
        return (self.estimate - self.truth) / self.sigma


def true_values(truth: Truth) -> dict[str, float]:
    """True parameters [SI] by name; those of effects as ``head-sag:sag``, with the place behind where there is one."""
    found = dict(truth.instrument)
    for applied in truth.effects:
        place = f" {applied.effect.place}" if applied.effect.place else ""
        for parameter, value in zip(applied.effect.parameters, applied.values, strict=True):
            found[f"{applied.effect.name}:{parameter.name}{place}"] = float(value)
    return found


def check_known(names: Sequence[str], true: Mapping[str, float], truth: Truth) -> None:
    """Raise SetupError for a parameter that is not among the true ones."""
    unknown = [name for name in names if name not in true]
    if unknown:
        raise SetupError(
            f"the calibrator's parameter {unknown[0]} is not one that the simulated instrument "
            f"({truth.construction}) has; recover with its own construction"
        )


def score(found: Calibration, truth: Truth, law: Mapping[str, tuple[float, float]]) -> Trial:
    """What ltsim's calibration says of a truth; raises SetupError where that lacks parameters of the calibration.

    `law` holds mean and standard deviation [SI] from which each true parameter was drawn; 0 for a stated one.
    """
    check_known(found.names, truth.instrument, truth)
    true = np.array([truth.instrument[name] for name in found.names])
    prior = found.prior_sigma.ravel()
    mean, drawn = np.array([law[name] for name in found.names]).T / prior
    error, stated = (found.values.ravel() - true) / prior, found.sigma.ravel() / prior
    left = stated**2 - found.missed**2 @ (1.0 - drawn**2)
    noisy = left > NOISELESS * stated**2
    standard = np.where(noisy, (error + found.missed @ mean) / np.sqrt(np.where(noisy, left, 1.0)), np.nan)
    network = Network(
        *_network_scores(found, truth, mean, drawn), found.fit.chi2, found.fit.dof, *_chi2(found, mean, drawn)
    )
    units = tuple(truth.units[name] for name in found.names)
    factor = np.array([FACTOR[unit] for unit in units])
    own = np.stack([found.values.ravel() / factor, found.sigma.ravel() / factor, true / factor, standard])
    more = true_values(truth)
    fitted = {name: entry for name, entry in _of_effects(found).items() if name in more}
    plain = 1.0 if _as_the_prior(mean, drawn) else np.nan  # else the parameters' priors move effects too
    beside = np.array([[e.value, e.sigma or np.nan, more[name] / FACTOR[e.unit]] for name, e in fitted.items()])
    beside = beside.reshape(-1, 3).T
    z = plain * (beside[0] - beside[2]) / beside[1]
    value, sigma, right, scores = np.concatenate([own, np.vstack([beside, z])], axis=1)
    names, shown = tuple(found.names) + tuple(fitted), units + tuple(e.unit for e in fitted.values())
    return Trial(names, shown, value, sigma, right, scores, network)


def _of_effects(found: Calibration) -> dict[str, Estimate]:
    """Parameters of effects that were estimated beside the calibration, by the names of `true_values`."""
    return {
        f"{entry.effect}:{own.name}" + (f" {entry.where}" if entry.where else ""): Estimate(
            own.value, own.sigma, own.unit
        )
        for entry in found.effects
        for own in entry.parameters
        if isinstance(own.value, float) and own.sigma
    }


def _chi2(found: Calibration, mean: Floats, drawn: Floats) -> tuple[float, float]:
    """Mean and standard deviation of chi-square with truths of a mean and a spread (p,) [prior sigmas]."""
    dof, sigma = found.fit.dof, found.fit.chi2_sigma
    if found.method != "network":
        return (dof, sigma) if _as_the_prior(mean, drawn) and sigma is not None else (np.nan, np.nan)
    told = np.eye(len(mean)) - found.missed
    lean = float(mean @ told @ mean)
    return dof + lean - float(np.diag(told) @ (1.0 - drawn**2)), float(np.sqrt(2 * dof + 4 * lean))


def _as_the_prior(mean: Floats, drawn: Floats) -> bool:
    """Whether truths of a mean and a spread (p,) [prior sigmas] are drawn from the prior."""
    return not np.any(mean) and bool(np.all(drawn == 1.0))


def _network_scores(found: Calibration, truth: Truth, mean: Floats, drawn: Floats) -> tuple[float, float]:
    """Mean square of error over sigma of targets and poses, where the first station is held; NaN in another frame.

    Both as they are to be expected of truths of a mean and a spread (p,) [prior sigmas]; of stated ones for the network
    method alone.
    """
    adjustment, plain = found.adjustment, _as_the_prior(mean, drawn)
    unknown = found.method != "network" and not plain
    if adjustment is None or unknown or adjustment.problem.free.shape[1] < 6:
        return float("nan"), float("nan")
    # The truth moved to where the first station is held.
    held, origin = adjustment.state, truth.position[0]
    turn = truth.rotation[0] @ held.rotation[0].T
    unknowns, size = adjustment.problem.unknowns, np.zeros(adjustment.problem.unknowns.size)
    bias, less = size.copy(), size.copy()
    if not plain:
        pick = np.zeros((len(size), len(mean)))
        pick[unknowns.instrument.ravel(), np.arange(len(mean))] = 1.0 / found.prior_sigma.ravel()
        missed = adjustment.factor.covariance_columns(pick)
        bias, less = -missed @ mean, missed**2 @ (1.0 - drawn**2)
    points = (truth.points - origin) @ turn + held.position[0]
    variance = np.einsum("tii->ti", found.target_covariance) - less[unknowns.target]
    targets = float(np.mean((found.points - points - bias[unknowns.target]) ** 2 / variance))
    squares = []
    for i, station in enumerate(found.stations[1:], start=1):
        there, at = (truth.position[i] - origin) @ turn + held.position[0], unknowns.pose[i]
        apart = Rotation.from_quat(station.quaternion) * Rotation.from_matrix(turn.T @ truth.rotation[i]).inv()
        error = np.concatenate([station.position - there, apart.as_rotvec()]) - bias[at]
        sigma = np.concatenate([station.sigma_position, station.sigma_rotation])
        squares.append(error**2 / (sigma**2 - less[at]))
    return targets, float(np.mean(squares)) if squares else float("nan")
