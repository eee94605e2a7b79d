"""Ideal observer, which knows the hall and the list of laws, but no drawn value (RULES.md).

Its marginal likelihoods are Monte Carlo means over draws of the constants of each law.
"""

import csv
import json
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp

from .hall import LENGTH_SIGMA, Hall
from .law import OBSERVABLES, Cause, Draw, laws_of
from .laws.catalogue import KNOWN
from .make import TRUTH, Case, draw_case
from .measure import Model
from .network import STEPS, Network
from .score import MIN_SHOWN_FRACTION
from .tracker import ARCSECOND, GUARANTEED, Array, Change, Pointings, within_a_turn

LawFunction = Callable[[Hall, Draw], Cause]
DRAWS, FURTHER_DRAWS, FURTHER_LAWS = 100, 400, 6
"""Draws of each law; further draws of the laws with the largest evidence; number of laws with further draws."""
STRENGTHS = np.geomspace(10.0, 3000.0, 16)
"""Grid of expected strengths with equal prior probability, that is, log-uniform."""
NULLS = 99
"""Number of simulated recordings without a cause; the p-value is the rank of the recording among them."""
LEVEL = 0.05


@dataclass(frozen=True)
class Linear:
    """Derivatives of the whitened readings by the parts of a `Change`, one block (n, 3, k) each."""

    network: Network
    blocks: dict[str, Array]

    @classmethod
    def of(cls, network: Network) -> "Linear":
        """Central differences at the true values of the hall."""
        hall = network.hall
        steps = {"target": STEPS, "station": STEPS, "turn": STEPS, "constants": GUARANTEED}
        blocks = {
            part: _part_derivatives(hall.pointings, part, step) / hall.sigma[:, :, None] for part, step in steps.items()
        }
        return cls(network, blocks)

    def signature(self, change: Change) -> Array:
        """(m,) Whitened change of the readings and lengths, to first order."""
        hall, parts = self.network.hall, change.parts
        whole = np.zeros((hall.n, 3))
        if "reading" in parts:
            whole += parts["reading"] / hall.sigma
        for part, block in self.blocks.items():
            if part in parts:
                whole += (block @ parts[part][:, :, None])[:, :, 0]
        rows = np.zeros(len(self.network.design))
        rows[: whole.size] = whole.ravel()
        if change.lengths is not None:
            rows[whole.size : whole.size + len(change.lengths)] = change.lengths / LENGTH_SIGMA
        return rows


def _part_derivatives(p: Pointings, part: str, steps: Array) -> Array:
    """(n, 3, k) Derivatives of the readings by one part of `Change`."""
    columns = []
    for step in np.diag(steps):
        moved = np.tile(step, (len(p), 1))
        change = p.readings(Change(**{part: moved})) - p.readings(Change(**{part: -moved}))
        change[:, 1] = within_a_turn(change[:, 1])
        columns.append(change / (2 * step.sum()))
    return np.stack(columns, axis=2)


@dataclass(frozen=True)
class Draws:
    """Draws of one law in one hall, at size one.

    `signals` (m, d, k) are whitened changes of the readings; a law of the noise has `variances` (3 n, d) instead, which
    are added to the variance of the readings.
    """

    causes: list[Cause]
    signals: Array | None
    variances: Array | None

    @classmethod
    def of(cls, law: LawFunction, linear: Linear, rng: Draw, number: int) -> "Draws | None":
        """`number` draws of a law; None if the hall lacks something that the law needs."""
        causes = []
        for _ in range(number):
            try:
                causes.append(law(linear.network.hall, rng))
            except LookupError:
                continue
        if not causes:
            return None
        changes = [cause.change for cause in causes]
        if changes[0].variance is not None:
            variances = [np.zeros(linear.network.base.size) if c.variance is None else c.variance.ravel()
                         for c in changes]  # fmt: skip
            return cls(causes, None, np.stack(variances, axis=1))
        typical = np.sqrt(np.mean([cause.values**2 for cause in causes], axis=0))
        signals = [[linear.signature(part.scaled(v)) for part, v in zip(cause.parts, typical.tolist(), strict=True)]
                   for cause in causes]  # fmt: skip
        return cls(causes, np.moveaxis(np.array(signals), 2, 0), None)

    def evidence(self, network: Network, residuals: Array) -> Array:
        """(d, s, r) Log Bayes factors against no cause, by draw, size and residual vector of `residuals` (m, r)."""
        if self.variances is not None:
            return self._noise_evidence(network, residuals)
        values, _, scores = self._eigen(network, residuals)
        total = np.maximum(values.sum(axis=1), 1e-30)
        gain = (STRENGTHS[None, :] / total[:, None])[:, :, None] * values[:, None, :]  # (d, s, k)
        share = gain / (1.0 + gain) / np.maximum(values, 1e-30)[:, None, :]
        return np.asarray(0.5 * share @ scores**2 - 0.5 * np.log1p(gain).sum(axis=2)[:, :, None])

    def _eigen(self, network: Network, residuals: Array) -> tuple[Array, Array, Array]:
        """Eigenvalues (d, k) and eigenvectors (d, k, k) of projected Gram matrices; scores (d, k, r) of residuals."""
        assert self.signals is not None
        rows, draws, size = self.signals.shape
        flat = self.signals.reshape(rows, -1)
        inside = (network.basis.T @ flat).reshape(-1, draws, size)
        gram = np.einsum("mdi,mdj->dij", self.signals, self.signals) - np.einsum("mdi,mdj->dij", inside, inside)
        values, vectors = np.linalg.eigh(gram)
        scores = (flat.T @ residuals).reshape(draws, size, -1)
        return np.maximum(values, 0.0), vectors, np.swapaxes(vectors, 1, 2) @ scores

    def sizes(self, network: Network) -> Array:
        """(d, s) Factors on the added variance of each draw for each strength of `STRENGTHS`."""
        assert self.variances is not None
        grid = np.geomspace(1e-3, 1e3, 60)
        log_evidences = np.zeros((self.variances.shape[1], len(STRENGTHS)))
        for d, variance in enumerate(self.variances.T):
            at = [float(network.noise_strengths(1.0 + a * variance).sum()) for a in grid.tolist()]
            log_evidences[d] = np.exp(np.interp(np.log(STRENGTHS), np.log(np.maximum(at, 1e-30)), np.log(grid)))
        return log_evidences

    def _noise_evidence(self, network: Network, residuals: Array) -> Array:
        assert self.variances is not None
        redundancy, squares = network.redundancy, residuals[: network.base.size] ** 2
        values = []
        for variance, sizes in zip(self.variances.T, self.sizes(network), strict=True):
            factor = 1.0 + sizes[:, None] * variance
            values.append(0.5 * ((1.0 - 1.0 / factor) @ squares - (np.log(factor) @ redundancy)[:, None]))
        return np.array(values)

    def posterior(self, network: Network, residual: Array) -> tuple[Array, Array, Cause]:
        """Posterior means of whitened change (m,) and variance factors (3 n,), and the most probable draw."""
        evidence = self.evidence(network, residual[:, None])[:, :, 0]
        weights = np.exp(evidence - logsumexp(evidence))
        best = self.causes[int(np.argmax(weights.sum(axis=1)))]
        change, factor = np.zeros(len(residual)), np.ones(network.base.size)
        if self.variances is not None:
            return change, factor + self.variances @ (weights * self.sizes(network)).sum(axis=1), best
        assert self.signals is not None
        values, vectors, scores = self._eigen(network, residual[:, None])
        scale = STRENGTHS[None, :] / np.maximum(values.sum(axis=1), 1e-30)[:, None]
        shrunk = scale[:, :, None] * scores[:, None, :, 0] / (1.0 + scale[:, :, None] * values[:, None, :])
        amounts = (vectors @ (weights[:, :, None] * shrunk).sum(axis=1)[:, :, None])[:, :, 0]
        return np.tensordot(self.signals, amounts, axes=2), factor, best


def log_evidence(evidence: Array) -> Array:
    """(r,) Log of the marginal likelihood ratio: mean of exp(evidence) over draws and sizes."""
    return np.asarray(logsumexp(evidence, axis=(0, 1)) - np.log(evidence.shape[0] * evidence.shape[1]))


@dataclass(frozen=True)
class Opinion:
    """Law with the largest marginal likelihood, its probability, and the p-value of no cause.

    `change` (m,) and `factor` (3 n,) are the posterior means of its model; `cause` is the most probable draw.
    """

    law: str
    probability: float
    p_value: float
    change: Array
    factor: Array
    cause: Cause


def observe(network: Network, whitened: Array, laws: dict[str, LawFunction], rng: Draw) -> Opinion:
    """Opinion on the whitened differences (m,) between a recording and the true values of its hall."""
    linear = Linear.of(network)
    noise = rng.standard_normal((len(whitened), NULLS))
    residuals = network.residual(np.column_stack([whitened, noise]))
    draws = {name: draws_of_law for name, law in laws.items() if (draws_of_law := Draws.of(law, linear, rng, DRAWS))}
    first = np.array([log_evidence(draws_of_law.evidence(network, residuals)) for draws_of_law in draws.values()])
    whole = logsumexp(first, axis=0)
    p_value = float((1 + (whole[1:] >= whole[0]).sum()) / (NULLS + 1))
    evidence = dict(zip(draws, first[:, 0].tolist(), strict=True))
    residual = residuals[:, 0]
    for name in sorted(evidence, key=lambda n: -evidence[n])[:FURTHER_LAWS]:
        further_draws = Draws.of(laws[name], linear, rng, FURTHER_DRAWS)
        if further_draws is not None:
            draws[name] = further_draws
            evidence[name] = float(log_evidence(further_draws.evidence(network, residual[:, None]))[0])
    best = max(evidence, key=lambda n: evidence[n])
    probability = float(np.exp(evidence[best] - logsumexp([np.log(len(laws)), *evidence.values()])))
    return Opinion(best, probability, p_value, *draws[best].posterior(network, residual))


def answer(recording: Path, out: Path) -> None:
    """Write the answer for one recording; of the truth, only the seed of the hall and the list of laws are used."""
    truth = json.loads((recording.parent.parent / TRUTH).read_text(encoding="utf-8"))[recording.name]
    case = Case.of(truth)
    hall, network, _, _ = draw_case(case, Counter())
    laws: dict[str, LawFunction] = {**KNOWN, **laws_of(case.laws)}
    readings, lengths = read_recording(recording, hall)
    whitened = network.whitened(readings - network.base, lengths - hall.lengths)
    whitened[-hall.pointings.constants.size :] = -(hall.pointings.constants / GUARANTEED).ravel()
    opinion = observe(network, whitened, laws, case.stream("ideal"))
    count = network.base.size
    change = (opinion.change[:count].reshape(-1, 3)) * hall.sigma
    model = Model(change, opinion.factor.reshape(-1, 3), LENGTH_SIGMA * opinion.change[count:][: len(hall.bars)],
                  {"law": opinion.law, "coefficients": len(opinion.cause.parts)})  # fmt: skip
    mismatch = opinion.p_value <= LEVEL
    (model if mismatch else Model.nothing(network)).write(out)
    content = {"verdict": "mismatch" if mismatch else "consistent", "global_test": {"p_value": opinion.p_value},
               "findings": [finding_of(network, opinion)] if mismatch else []}  # fmt: skip
    (out / "diagnosis.json").write_text(json.dumps(content) + "\n", encoding="utf-8")
    points = adjusted_points(network, whitened - mismatch * opinion.change, opinion.factor if mismatch else None)
    rows = [f"{name},{','.join(f'{1e3 * x:.6f}' for x in point)}"
            for name, point in zip(hall.targets, points.tolist(), strict=True)]  # fmt: skip
    (out / "targets.csv").write_text("\n".join(["target,x_mm,y_mm,z_mm", *rows]) + "\n", encoding="utf-8")


def finding_of(network: Network, opinion: Opinion) -> dict[str, Any]:
    """Finding of an opinion: name, place of the most probable draw, observables of the model."""
    words = opinion.cause.words
    noise = bool((opinion.factor != 1.0).any())
    parts = (network.noise_strengths(opinion.factor) if noise else network.mean_strengths(opinion.change))[:3]
    shown = [n for n, part in zip(OBSERVABLES, parts.tolist(), strict=True) if part > MIN_SHOWN_FRACTION * parts.sum()]
    where = {key: words.get(key, []) for key in ("stations", "targets", "instruments")}
    where["observables"] = words.get("observables", shown)
    where["covariates"] = [alternatives[0] for alternatives in words.get("follows", ())]
    effect = opinion.law if opinion.law in KNOWN else "unknown"
    return {"effect": effect, "where": where, "evidence": {"probability": opinion.probability}}


def adjusted_points(network: Network, right: Array, factor: Array | None) -> Array:
    """(T, 3) [m] Targets adjusted to whitened differences (m,), with factors on the variance of the readings."""
    weight = np.ones(len(right))
    if factor is not None:
        weight[: len(factor)] = 1.0 / np.sqrt(factor)
    points = network.hall.pointings.points
    design = network.design * weight[:, None]
    size = np.sqrt((design**2).sum(axis=0))
    moved = np.linalg.lstsq(design / size, right * weight, rcond=1e-12)[0] / size
    return np.asarray(points + moved[: points.size].reshape(-1, 3))


def read_recording(recording: Path, hall: Hall) -> tuple[Array, Array]:
    """Readings (n, 3) [m, rad, rad] and lengths (g,) [m] of a recording, in the order of its files."""
    with (recording / "observations.csv").open(encoding="utf-8") as lines:
        rows = [[float(r[name]) for name in ("distance_mm", "azimuth_deg", "elevation_deg")]
                for r in csv.DictReader(lines)]  # fmt: skip
    with (recording / "setup.toml").open("rb") as file:
        gauge = tomllib.load(file)["gauge"]["distance"]
    degree = 3600.0 * ARCSECOND
    return np.array(rows) * [1e-3, degree, degree], np.array([1e-3 * entry["length_mm"] for entry in gauge])
