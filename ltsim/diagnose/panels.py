"""Panels of the space: carriers x drivers x places, scored all at once by sums over the pointings of each place.

The score of carrier c with driver d at a place is the sum over its pointings of (derivative of c) x (column of d) x
(residual): one matrix product a place, however many hypotheses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Floats, Ints, Singles
from ltsim.diagnose.carriers import Carrier, carrier_designs
from ltsim.diagnose.drivers import (
    CONSTANT,
    Driver,
    across_the_room,
    edges,
    further,
    general_drivers,
    products,
    simple,
    smooth,
    waves,
)
from ltsim.diagnose.evidence import forms_of, log_average, log_evidence_of, simulated_evidence
from ltsim.diagnose.probe import Probe
from ltsim.scene.sightings import Sightings

CHUNK = 1000
"""Pointings whose products are held at once."""
MOST_STATIONS, MOST_TARGETS = 400, 400
"""Places up to whose number each is tried on its own."""
NEIGHBOURS = (3, 6, 9)
"""Targets that stand together: one with so many around it."""


Form = tuple[Floats, tuple[Floats, Floats], Singles]


@dataclass(frozen=True)
class Place:
    """Where a law acts: names of set-ups or targets, and their pointings."""

    stations: tuple[str, ...]
    targets: tuple[str, ...]
    rows: Ints
    instruments: tuple[str, ...] = ()


@dataclass(frozen=True)
class Hit:
    """One hypothesis of a panel and its log evidence with its prior."""

    carrier: Carrier
    driver: Driver
    place: Place
    value: float
    log_prior: float


@dataclass(frozen=True)
class Panel:
    """Carriers, drivers of one number of columns and scales, places, and the log prior (C,) of each hypothesis."""

    carriers: tuple[Carrier, ...]
    drivers: tuple[Driver, ...]
    places: tuple[Place, ...]
    weights: Singles
    columns: Singles
    log_prior: Floats
    _forms: dict[int, list[Form]] = field(default_factory=dict, repr=False)

    @cached_property
    def _spreads(self) -> list[Floats]:
        """(D, k) standard deviations for each scale."""
        return [np.stack(sets) for sets in zip(*(d.spreads for d in self.drivers), strict=True)]

    def score(self, probe: Probe) -> tuple[list[Hit], float, Floats]:
        """The hypotheses of every place worth a second look, and the log sums of all: here, and in trials (trials,)."""
        hits: list[Hit] = []
        sums: list[float] = []
        null = np.full(probe.scored, -np.inf)
        for number, place in enumerate(self.places):
            values, total = self._at(probe, number)
            null = np.logaddexp(null, total)
            sums.append(float(log_average(values.ravel())))
            best = np.argsort(-values.ravel())[:MOST_HITS]
            for flat in best:
                c, d = np.unravel_index(int(flat), values.shape)
                hits.append(
                    Hit(self.carriers[c], self.drivers[d], place, float(values[c, d]), float(self.log_prior[c]))
                )
        return hits, float(log_average(np.array(sums))), null

    def _at(self, probe: Probe, number: int) -> tuple[Floats, Floats]:
        """Log evidence (C, D) with priors at a place, and its log sum over trials.

        Beside what was found, what the adjustment leaves of a law is taken to be what it left before: too much where
        the two are alike. Whatever is worth a second look is computed exactly.
        """
        rows = self.places[number].rows
        scores = self._sums(probe, rows)
        score, _, trials, _ = probe.split(scores)
        if probe.fresh:
            self._forms[number] = self._turned(probe.gram(scores, self._own(rows)))
        null = np.full(probe.scored, -np.inf)
        every = []
        for strength, forms, turn in self._forms[number]:
            every.append(log_evidence_of((turn @ score[..., None])[..., 0] ** 2, forms))
            if len(null):
                chance = simulated_evidence(turn @ trials, strength)
                chance += self.log_prior[:, None, None]
                null = np.logaddexp(null, log_average(chance.reshape(-1, len(null))))
        return log_average(np.stack(every)) + self.log_prior[:, None], null

    def _turned(self, gram: Floats) -> list[Form]:
        """For each scale eigenvalues (C, D, k), their forms, and what turns scores into those along eigenvectors."""
        found = []
        for spread in self._spreads:
            strength, turn = np.linalg.eigh(gram * spread[:, :, None] * spread[:, None, :])
            turn = np.swapaxes(turn, -1, -2) * spread[:, None, :]
            strength = np.maximum(strength, 0.0)
            found.append((strength, forms_of(strength), turn.astype(np.float32)))
        return found

    @property
    def _sizes(self) -> Singles:
        return np.array([c.size for c in self.carriers], dtype=np.float32)

    def _sums(self, probe: Probe, rows: Ints) -> Singles:
        """Products (C, D, k, v) of all columns with the probe's vectors at a place."""
        count, d, k = len(self.carriers), len(self.drivers), self._spreads[0].shape[1]
        scores = np.zeros((d * k, count * probe.vectors.shape[1]), dtype=np.float32)
        for start in range(0, len(rows), CHUNK):
            part = rows[start : start + CHUNK]
            moved = np.einsum("nic,niv->ncv", self.weights[part] * self._sizes, probe.pointings[part])
            scores += self.columns[part].T @ moved.reshape(len(part), -1)
        return np.ascontiguousarray(scores.reshape(d, k, count, -1).transpose(2, 0, 1, 3))

    def _own(self, rows: Ints) -> Floats:
        """Products (C, D, k, k) of the columns of each hypothesis with each other."""
        d, k = len(self.drivers), self._spreads[0].shape[1]
        own = np.zeros((len(self.carriers), d * k * k))
        for start in range(0, len(rows), CHUNK):
            part = rows[start : start + CHUNK]
            blocks = self.columns[part].reshape(len(part), d, k)
            pairs = np.einsum("nda,ndb->ndab", blocks, blocks).reshape(len(part), -1)
            own += ((self.weights[part] * self._sizes) ** 2).sum(axis=1).T @ pairs
        return own.reshape(-1, d, k, k)


MOST_HITS = 6
"""Hypotheses a place that are looked at again."""

SHARES = {
    "anywhere": 0.32,  # any carrier, any driver, the whole recording
    "station": 0.15,  # the same at one set-up
    "instrument": 0.10,  # the same at all set-ups of one instrument
    "product": 0.16,  # a reading that follows two drivers
    "wave": 0.08,  # a reading that swings
    "sway": 0.02,  # anything else that swings in time
    "structure": 0.04,  # targets that move together, more the farther across the room
    "edge": 0.06,  # a reading that jumps or bends
    "target": 0.04,  # one target
    "group": 0.03,  # targets that stand together
}
"""How the prior of laws without a card is shared."""


def panels(space: ResidualSpace, mass: float) -> list[Panel]:
    """All panels of a recording; their priors sum to `mass`."""
    made = _Maker(space)
    s = space.sightings
    everywhere = (Place((), (), np.arange(len(s))),)
    stations = tuple(_stations(s)) if 1 < len(s.station_names) <= MOST_STATIONS else ()
    instruments = tuple(_instruments(space)) if s.instrument.max() > 0 else ()
    targets = tuple(_targets(s)) if 1 < len(s.target_names) <= MOST_TARGETS else ()
    groups = tuple(_groups(s)) if 12 <= len(s.target_names) <= 100 else ()
    general, readings = general_drivers(s), ("reading",)
    clock = [smooth(n) for n in ("time", *further(s)) if np.ptp(s.quantities[n]) > 0]
    plain = [CONSTANT, *(simple(n, "power") for n in ("time", "distance", "elevation") if np.ptp(s.quantities[n]) > 0)]
    plain += [simple(n, "power") for n in further(s)]
    swings = [d for d in waves(s) if d.covariates == ("time",)]
    requests = [
        ("anywhere", general, everywhere, ()),
        ("station", general, stations, ()),
        ("instrument", general, instruments, ()),
        ("product", list(products(s)), everywhere, readings),
        ("wave", list(waves(s)), everywhere, ("reading", "vertical index")),
        ("sway", swings, everywhere, ("air", "structure", "target", "stand")),
        ("structure", across_the_room([*swings, *clock, *plain[1:]]), everywhere, ("target",)),
        ("edge", list(edges(s)), everywhere, readings),
        ("target", [*plain, *clock], targets, ("reading", "target")),
        ("group", [*plain, *clock], groups, ("reading", "target")),
    ]
    asked = [r for r in requests if r[1] and r[2]]
    whole = sum(SHARES[name] for name, *_ in asked)
    return [p for name, d, where, kinds in asked for p in made.panels(d, where, kinds, mass * SHARES[name] / whole)]


class _Maker:
    def __init__(self, space: ResidualSpace) -> None:
        self._s = space.sightings
        self._sigma, self._use = space.sigma, space.use
        self._known = carrier_designs(self._s)

    def panels(
        self, drivers: Sequence[Driver], places: tuple[Place, ...], kinds: tuple[str, ...], mass: float
    ) -> Iterator[Panel]:
        """Panels of drivers alike in columns and scales."""
        chosen = [(c, d) for c, d in self._known.values() if not kinds or c.kind in kinds or c.name in kinds]
        weights = np.stack([np.where(self._use, d / self._sigma, 0.0) for _, d in chosen], axis=2)
        carriers = tuple(at_noise(c, weights[:, :, i]) for i, (c, _) in enumerate(chosen))
        alike: dict[tuple[int, int], list[Driver]] = {}
        for driver in drivers:
            alike.setdefault((driver.size, len(driver.spreads)), []).append(driver)
        count = len(places) * sum(len(d.spreads) for d in drivers)
        log_prior = np.log(mass / count * _shares(carriers))
        for same in alike.values():
            columns = np.hstack([d.columns(self._s) for d in same])
            yield Panel(
                carriers, tuple(same), places, weights.astype(np.float32), columns.astype(np.float32), log_prior
            )


READINGS = 0.5
"""Share of the readings themselves among the carriers: what errs in no known way shows in a reading alone."""


def _shares(carriers: Sequence[Carrier]) -> Floats:
    """Prior share (C,) of each carrier."""
    reading = np.array([c.kind == "reading" for c in carriers])
    if reading.all() or not reading.any():
        return np.full(len(carriers), 1.0 / len(carriers))
    return np.where(reading, READINGS / reading.sum(), (1.0 - READINGS) / (~reading).sum())


def at_noise(carrier: Carrier, weights: Floats) -> Carrier:
    """The carrier with a plausible size that at least reaches the noise: nobody models what no reading feels."""
    strength = np.sqrt(np.sum(weights**2, axis=1))
    felt = float(np.median(strength[strength > 0])) if (strength > 0).any() else 0.0
    size = max(carrier.size, 1.0 / felt) if felt > 0 else carrier.size
    return Carrier(carrier.name, carrier.unit, size, carrier.observables, carrier.kind)


def _stations(s: Sightings) -> Iterator[Place]:
    for i, name in enumerate(s.station_names):
        rows = np.flatnonzero(s.station == i)
        if len(rows):
            yield Place((name,), (), rows)


def _instruments(space: ResidualSpace) -> Iterator[Place]:
    s, names = space.sightings, space.adjustment.recording.instruments
    for i, name in enumerate(names):
        rows = np.flatnonzero(s.instrument == i)
        if len(rows):
            yield Place(tuple(s.station_names[k] for k in np.unique(s.station[rows])), (), rows, (name,))


def _targets(s: Sightings) -> Iterator[Place]:
    for i, name in enumerate(s.target_names):
        rows = np.flatnonzero(s.target == i)
        if len(rows):
            yield Place((), (name,), rows)


def _groups(s: Sightings) -> Iterator[Place]:
    """Targets that stand together, and what lies beyond the middle of the room along each axis."""
    found = set()
    for point in s.points:
        near = np.argsort(np.linalg.norm(s.points - point, axis=1), kind="stable")
        found |= {tuple(sorted(near[: k + 1].tolist())) for k in NEIGHBOURS if 2 * k < len(near)}
    for members in sorted(found):
        rows = np.flatnonzero(np.isin(s.target, members))
        if len(rows):
            yield Place((), tuple(s.target_names[t] for t in members), rows)
