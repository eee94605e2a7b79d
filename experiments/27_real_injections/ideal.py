"""The ideal observer of the injections: Bayes over the list of causes, their places and shapes, in linearised networks.

It knows the kinds that are injected, equally likely, and the adjustment of the recording; not which cause, where, what
shape and size. Residuals are Gaussian with the covariance of the adjustment and the noise that the readings have.
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
"""Expected noncentralities, equally likely: the observer does not know which one was injected."""
LOG_ODDS_NONE = 0.0
"""Log prior odds of no cause against any."""
STRENGTH = 100.0
"""Noncentrality of the injections."""
CARDS = tuple(
    kind.name
    for kind in CATALOGUE
    if not issubclass(kind, NoiseEffect | Blunder)
    and kind.name not in {effect.name for effect in ORDINARY_CALIBRATION_EFFECTS}
)
"""Effects of the catalogue that change readings and that the ordinary calibration does not estimate."""
MOST_BACKGROUND = 5
"""Causes of the list in a recording as it is."""


@dataclass(frozen=True)
class Instance:
    """A cause at one place and of one shape, and its kind in the words of the plan."""

    kind: str
    cause: CandidateEffect

    @property
    def key(self) -> tuple[object, ...]:
        """Identity of the cause that the observer reports: kind, stations, targets and instruments."""
        cause = self.cause
        return self.kind, tuple(cause.stations), tuple(cause.targets), tuple(getattr(cause, "instruments", ()))


@dataclass(frozen=True)
class Observer:
    """The list of causes in the residual space of a recording."""

    space: ResidualSpace
    instances: Sequence[Instance]

    @classmethod
    def of(cls, space: ResidualSpace, kinds: Sequence[str], unit: str) -> "Observer":
        """Observer of a recording, with a list of the kinds of causes."""
        recording, instances = space.adjustment.recording, list[Instance]()
        for kind in dict.fromkeys(kinds):
            texts = [kind.format(station=s, unit=unit) for s in recording.stations] if "{station}" in kind else [kind]
            for text in texts:
                causes = parse_requested_effect(text, recording).candidates(space.adjustment)
                instances += [Instance(kind, cause) for cause in causes]
        return cls(space, instances)

    @cached_property
    def _projected(self) -> list[tuple[Floats, Floats]]:
        """Projected signatures (m, k) along the eigenvectors of their Gram matrix, and its eigenvalues (k,)."""
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
        """Log prior probabilities (h,): kinds are equally likely, and in each its visible places and shapes."""
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
        for _ in range(MOST_BACKGROUND):
            opinion = observer.opinion(observer.space.whitened_residuals)
            if opinion is None:
                break
            observer = Observer(observer.space.with_effects([opinion.cause]), self.instances)
        return observer

    def opinion(self, residual: Floats) -> Instance | None:
        """Most probable kind and place given residuals (m,), in its most probable shape; None without a cause."""
        logs = self.log_evidence(residual[:, None])[:, 0] + self.log_prior
        if logsumexp(logs) < LOG_ODDS_NONE:
            return None
        groups: dict[tuple[object, ...], list[int]] = {}
        for number, instance in enumerate(self.instances):
            groups.setdefault(instance.key, []).append(number)
        best = max(groups.values(), key=lambda members: float(logsumexp(logs[members])))
        return self.instances[max(best, key=lambda member: float(logs[member]))]


def examined(network: Row, settings: Row) -> list[Row]:
    """Rows of the injections of strength 100 into a network: located by the observer, located and named.

    With `simulated` residuals; with those of the original recording (`listed`), where the observer estimates the causes
    on its list; and with these residuals and all effects of the catalogue on the list (`catalogue`).
    """
    _, weighted, _ = background(network["file"], network.get("clockwise", False), estimates_noise=False)
    space = ResidualSpace.from_adjustment(adjust(weighted, declared_construction(weighted)))
    kinds, unit = settings["kinds"], unit_of(weighted)
    simulated, catalogue = Observer.of(space, kinds, unit), Observer.of(space, [*CARDS, *kinds], unit)
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
