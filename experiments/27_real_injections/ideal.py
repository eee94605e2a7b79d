"""Ideal observer of the injections: Bayes' rule over all causes, places and shapes, in linearised networks.

The observer knows the kinds of causes that are injected, which are equally probable, and the adjustment of the
recording; it does not know the kind, place, shape and size of a cause. Residuals are Gaussian with the covariance of
the adjustment and the estimated noise of the readings.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.special import logsumexp

from experiments.common import Row
from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.verbs import parse_requested_effect
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects import CATALOGUE, ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.effect import Blunder, NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.model.construction import declared_construction

from .injections import background, injection, is_located, unit_of

STRENGTHS = np.geomspace(10.0, 3000.0, 16)
"""Grid of expected noncentralities with equal prior probability: the observer does not know the injected one."""
LOG_ODDS_NONE = 0.0
"""Log prior odds of no cause against any cause."""
STRENGTH = 100.0
"""Noncentrality of the injections."""
CATALOGUE_EFFECTS = tuple(
    kind.name
    for kind in CATALOGUE
    if not issubclass(kind, NoiseEffect | Blunder)
    and kind.name not in {effect.name for effect in ORDINARY_CALIBRATION_EFFECTS}
)
"""Names of the catalogue effects that change readings and that the ordinary calibration does not estimate."""
MAX_BACKGROUND_CAUSES = 5
"""Largest number of causes that are estimated in an original recording, without injection."""


@dataclass(frozen=True)
class Instance:
    """Cause at one place and with one shape; `kind` is its text in the plan."""

    kind: str
    cause: CandidateEffect

    @property
    def key(self) -> tuple[object, ...]:
        """Identity of the cause that the observer reports: kind, stations, targets and instruments."""
        cause = self.cause
        return self.kind, tuple(cause.stations), tuple(cause.targets), tuple(getattr(cause, "instruments", ()))


@dataclass(frozen=True)
class Observer:
    """Listed causes in the residual space of a recording."""

    space: ResidualSpace
    instances: Sequence[Instance]

    @classmethod
    def of(cls, space: ResidualSpace, kinds: Sequence[str], unit: str) -> "Observer":
        """Observer of a recording, with all places and shapes of the listed kinds of causes."""
        recording, instances = space.adjustment.recording, list[Instance]()
        for kind in dict.fromkeys(kinds):
            texts = [kind.format(station=s, unit=unit) for s in recording.stations] if "{station}" in kind else [kind]
            for text in texts:
                causes = parse_requested_effect(text, recording).candidates(space.adjustment)
                instances += [Instance(kind, cause) for cause in causes]
        return cls(space, instances)

    @cached_property
    def _projected(self) -> list[tuple[Floats, Floats]]:
        """Projected signatures (m, k) in the basis of eigenvectors of their Gram matrix, and its eigenvalues (k,)."""
        signatures = []
        for instance in self.instances:
            rows = self.space.whitened_design(instance.cause) * instance.cause.plausible_sizes
            projected = self.space.project(rows)
            values, vectors = np.linalg.eigh(projected.T @ projected)
            visible = values > NORMAL_EQUATIONS_TOLERANCE * float(np.max(np.sum(rows**2, axis=0), initial=0.0))
            signatures.append(((projected @ vectors[:, visible]).astype(np.float32), values[visible]))
        return signatures

    @cached_property
    def log_prior(self) -> Floats:
        """Log prior probabilities (h,): equal for all kinds, and equal for the detectable instances of a kind."""
        kinds = [i.kind if len(values) else "" for i, (_, values) in zip(self.instances, self._projected, strict=True)]
        names = sorted(set(kinds) - {""})
        count = {name: kinds.count(name) for name in names}
        return np.array([-np.log(len(names) * count[kind]) if kind else -np.inf for kind in kinds])

    def log_evidence(self, residuals: Floats) -> Floats:
        """Log marginal likelihood ratios (h, r) of the instances against no cause, given residuals (m, r)."""
        log_evidences = np.zeros((len(self.instances), residuals.shape[1]))
        for log_evidence_row, (rows, values) in zip(log_evidences, self._projected, strict=True):
            if not len(values):
                continue
            scores = (rows.T @ residuals) ** 2
            gain = STRENGTHS[:, None] / values.sum() * values
            logs = 0.5 * (gain / (1.0 + gain) / values) @ scores - 0.5 * np.log1p(gain).sum(axis=1)[:, None]
            log_evidence_row[:] = logsumexp(logs, axis=0) - np.log(len(STRENGTHS))
        return log_evidences

    def with_background(self) -> "Observer":
        """Observer that estimates also those causes of its list that the original recording contains."""
        observer = self
        for _ in range(MAX_BACKGROUND_CAUSES):
            opinion = observer.opinion(observer.space.whitened_residuals)
            if opinion is None:
                break
            observer = Observer(observer.space.with_effects([opinion.cause]), self.instances)
        return observer

    def opinion(self, residual: Floats) -> Instance | None:
        """Most probable instance given residuals (m,); None if no cause is more probable."""
        logs = self.log_evidence(residual[:, None])[:, 0] + self.log_prior
        if logsumexp(logs) < LOG_ODDS_NONE:
            return None
        groups: dict[tuple[object, ...], list[int]] = {}
        for number, instance in enumerate(self.instances):
            groups.setdefault(instance.key, []).append(number)
        best = max(groups.values(), key=lambda members: float(logsumexp(logs[members])))
        return self.instances[max(best, key=lambda member: float(logs[member]))]


def examined_network(network: Row, settings: Row) -> list[Row]:
    """Rows of the injections of strength 100 into a network, with True if the observer located and named the cause.

    `simulated` observers have simulated residuals. `listed` observers have the residuals of the original recording, in
    which they estimate the causes on their list. `catalogue` observers also have all catalogue effects on their list.
    """
    _, weighted, _ = background(network["file"], network.get("clockwise", False), estimates_noise=False)
    space = ResidualSpace.from_adjustment(adjust(weighted, declared_construction(weighted)))
    kinds, unit = settings["kinds"], unit_of(weighted)
    simulated, catalogue = Observer.of(space, kinds, unit), Observer.of(space, [*CATALOGUE_EFFECTS, *kinds], unit)
    observers = {
        "simulated": simulated,
        "listed": simulated.with_background(),
        "catalogue": catalogue.with_background(),
    }
    rows = []
    for trial, kind in product(range(settings["trials"]), settings["kinds"]):
        row: Row = {"site": network["site"], "file": network["file"], "kind": kind, "trial": trial}
        try:
            made, truth = injection(network, kind, STRENGTH, trial, settings["seed"])
        except ModelError:
            continue
        change = np.nan_to_num(made.readings - weighted.readings)
        change[:, 1:] = wrap_angle(change[:, 1:])
        signal = space.project(space.whiten(change[:, :, None])[:, 0])
        noise = np.random.default_rng([settings["seed"], len(rows)]).standard_normal(space.n_equations)
        for name, observer in observers.items():
            residual = signal + (space.project(noise) if name == "simulated" else space.whitened_residuals)
            opinion = observer.opinion(residual)
            is_at_place = opinion is not None and is_located(truth.injected_effects[0].effect, opinion.cause, weighted)
            row |= {f"{name}_located": is_at_place, f"{name}_named": is_at_place and opinion.kind == kind}
        rows.append(row)
    return rows


def table_of(rows: Sequence[Row], ltsim: Sequence[Row]) -> list[Row]:
    """Numbers of injections located, and located and named, by ltsim and by the observer."""
    of_ltsim = {(r["file"], r["kind"], r["trial"]): r for r in ltsim if not r["hidden"]}
    table = []
    groups = [(column, name) for column in ("site", "kind") for name in dict.fromkeys(r[column] for r in rows)]
    for column, name in [("all", "all"), *groups]:
        group = [r for r in rows if column == "all" or r[column] == name]
        pairs = [of_ltsim[r["file"], r["kind"], r["trial"]] for r in group]
        counts = {"ltsim_located": [p["located"] for p in pairs], "ltsim_named": [p["reported"] for p in pairs]}
        counts |= {c: [r[c] for r in group] for c in rows[0] if c.endswith(("_located", "_named"))}
        row: Row = {"by": column, "of": name, "injections": len(group)}
        table.append(row | {c: sum(map(bool, hits)) for c, hits in counts.items()})
    return table
