"""Panels of the space: carriers x drivers x places, scored all at once by sums over the pointings of each place.

The score of carrier c with driver d at a place is the sum over its pointings of (derivative of c) x (column of d) x
(residual): one matrix product a place, however many hypotheses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Floats, Ints, Singles
from ltsim.diagnose.evidence import by_size, forms_of, log_average, simulated_total
from ltsim.diagnose.probe import Probe
from ltsim.laws.carriers import Carrier, carrier_designs
from ltsim.laws.columns import LOW, MODES
from ltsim.laws.drivers import CONSTANT, Driver, across_the_room, simple, smooth
from ltsim.laws.offered import further, general_drivers, lags, moves, products, sights, waves
from ltsim.laws.places import Place, branches, corners_of, each, together, trackers_of

CHUNK = 1000
"""Pointings whose products are held at once."""
MOST_PLACES = 400
"""Set-ups, or targets, up to whose number each is tried on its own."""
ROOM = 4
"""Pointings of a visit for each coefficient of a fine curve; with fewer a coarse one is tried."""


Form = tuple[Floats, tuple[Floats, Floats], Singles]


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
    """Carriers of one kind and c components, drivers alike in columns k and scales, places.

    Attributes
    ----------
    weights : (n, 3, C, c) float32
        Whitened change of the readings by a plausible size of each component.
    columns : (n, D k) float32
    log_prior : float
        Of each hypothesis and scale.
    """

    carriers: tuple[Carrier, ...]
    drivers: tuple[Driver, ...]
    places: tuple[Place, ...]
    weights: Singles
    columns: Singles
    log_prior: float
    _forms: dict[int, list[Form]] = field(default_factory=dict, repr=False)

    @cached_property
    def _spreads(self) -> list[Floats]:
        """(D, c k) standard deviations for each scale."""
        ways = self.weights.shape[3]
        return [np.tile(np.stack(sets), ways) for sets in zip(*(d.spreads for d in self.drivers), strict=True)]

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
                hits.append(Hit(self.carriers[c], self.drivers[d], place, float(values[c, d]), self.log_prior))
        return hits, float(log_average(np.array(sums))), null

    def _at(self, probe: Probe, number: int) -> tuple[Floats, Floats]:
        """Log evidence (C, D) with priors at a place, and its log sum over trials.

        Beside what was found, what the adjustment leaves of a law is taken to be what it left before: too much where
        the two are alike. Whatever is worth a second look is computed exactly.
        """
        rows = self.places[number].rows
        scores = self._sums(probe, rows)
        score, trials, _ = probe.split(scores)
        if probe.fresh:
            self._forms[number] = self._turned(probe.gram(scores, self._own(rows)))
        null = np.full(probe.scored, -np.inf)
        every = []
        for strength, forms, turn in self._forms[number]:
            every.append(log_average(by_size((turn @ score[..., None])[..., 0] ** 2, forms), axis=-1))
            if len(null):
                null = np.logaddexp(null, simulated_total(turn @ trials, strength) + self.log_prior)
        return log_average(np.stack(every)) + self.log_prior, null

    def _turned(self, gram: Floats) -> list[Form]:
        """For each scale eigenvalues (C, D, k), their forms, and what turns scores into those along eigenvectors."""
        found = []
        for spread in self._spreads:
            strength, turn = np.linalg.eigh(gram * spread[:, :, None] * spread[:, None, :])
            turn = np.swapaxes(turn, -1, -2) * spread[:, None, :]
            strength = np.maximum(strength, 0.0)
            found.append((strength, forms_of(strength), turn.astype(np.float32)))
        return found

    def _sums(self, probe: Probe, rows: Ints) -> Singles:
        """Products (C, D, c k, v) of all columns with the probe's vectors at a place."""
        _, _, count, ways = self.weights.shape
        d, k = len(self.drivers), self.columns.shape[1] // len(self.drivers)
        scores = np.zeros((d * k, count * ways * probe.vectors.shape[1]), dtype=np.float32)
        for start in range(0, len(rows), CHUNK):
            part = rows[start : start + CHUNK]
            weights = self.weights[part].reshape(len(part), 3, -1)
            moved = np.swapaxes(weights, 1, 2) @ probe.pointings[part]
            scores += self.columns[part].T @ moved.reshape(len(part), -1)
        shaped = scores.reshape(d, k, count, ways, -1).transpose(2, 0, 3, 1, 4)
        return np.ascontiguousarray(shaped).reshape(count, d, ways * k, -1)

    def _own(self, rows: Ints) -> Floats:
        """Products (C, D, c k, c k) of the columns of each hypothesis with each other."""
        _, _, count, ways = self.weights.shape
        d, k = len(self.drivers), self.columns.shape[1] // len(self.drivers)
        own = np.zeros((count * ways * ways, d * k * k))
        for start in range(0, len(rows), CHUNK):
            part = rows[start : start + CHUNK]
            blocks = self.columns[part].reshape(len(part), d, k)
            pairs = (blocks[:, :, :, None] * blocks[:, :, None, :]).reshape(len(part), -1)
            weights = self.weights[part]
            own += np.einsum("nica,nicb->ncab", weights, weights).reshape(len(part), -1).T @ pairs
        shaped = own.reshape(count, ways, ways, d, k, k).transpose(0, 3, 1, 4, 2, 5)
        return shaped.reshape(count, d, ways * k, ways * k)


FEW_RATES = 18
"""Rates of waves, the slowest ones, that a group of targets is tried with."""
MOST_HITS = 6
"""Hypotheses a place that are looked at again."""

SHARES = {
    "anywhere": 0.35,  # any carrier, any driver, the whole recording
    "station": 0.15,  # the same at one set-up
    "instrument": 0.10,  # the same at all set-ups of one instrument
    "product": 0.12,  # a reading that follows two drivers
    "sight": 0.03,  # a reading that errs on the way to the target, or that a list has one row late
    "wave": 0.08,  # a reading that swings
    "swing": 0.02,  # one set-up that swings in time
    "swing of a group": 0.02,  # targets that belong together that do
    "sway": 0.02,  # anything else that swings in time
    "structure": 0.04,  # targets that move together, more the farther across the room
    "target": 0.04,  # one target
    "group": 0.02,  # targets that belong together
    "tilt": 0.04,  # the same, more the farther across the group
    "corner": 0.02,  # a target and those around it
}
"""How the prior of laws without a card is shared."""
KINDS = {
    "reading": 0.5,
    "instrument": 0.17,
    "circle": 0.03,
    "stand": 0.2,
    "target": 0.04,
    "reflector": 0.02,
    "air": 0.04,
}
"""Prior shares of the kinds of carriers: what errs in no known way shows in a reading alone, and where all
targets seem to move alike it is the stands."""
AT_SET_UPS = {"reading": 0.4, "instrument": 0.09, "circle": 0.01, "stand": 0.46, "air": 0.04}
"""The same for what happens at one set-up: the instrument is the same at the others, the stand is not."""
AT_INSTRUMENTS = {"reading": 0.5, "instrument": 0.25, "circle": 0.05, "stand": 0.15, "air": 0.05}
"""The same for what happens to one of several instruments."""
AT_TARGETS = {"reading": 0.2, "target": 0.8}
"""The same for what happens at some targets: an instrument does not know where it looks."""


def panels(space: ResidualSpace, mass: float) -> list[Panel]:
    """All panels of a recording; their priors sum to `mass`."""
    made = _Maker(space)
    s = space.sightings
    everywhere = (Place((), (), np.arange(len(s))),)
    stations: tuple[Place, ...] = ()
    targets: tuple[Place, ...] = ()
    if 1 < len(s.station_names) <= MOST_PLACES:
        stations = tuple(Place((name,), (), rows) for name, rows in each(s.station_names, s.station))
    if 1 < len(s.target_names) <= MOST_PLACES:
        targets = tuple(Place((), (name,), rows) for name, rows in each(s.target_names, s.target))
    instruments = trackers_of(s, space.adjustment.recording.instruments)
    some = 12 <= len(s.target_names) <= 100
    groups, corners = (tuple(together(s, sets(s))) if some else () for sets in (branches, corners_of))
    general = general_drivers(s)
    visits = float(np.median([len(place.rows) for place in stations] or [0]))
    there = general if visits > ROOM * MODES else general_drivers(s, LOW)
    clock = [smooth(n, LOW) for n in ("time", *further(s)) if np.ptp(s.quantities[n]) > 0]
    plain = [CONSTANT, *(simple(n, "power") for n in ("time", "distance", "elevation") if np.ptp(s.quantities[n]) > 0)]
    plain += [*(simple(n, "power") for n in further(s)), *lags(s, further(s))]
    swings = [d for d in waves(s) if d.covariates == ("time",)]
    bent = [*across_the_room(swings, 1), *across_the_room([*clock, *plain[1:]], 2)]
    requests = [
        ("anywhere", general, everywhere, KINDS),
        ("station", there, stations, AT_SET_UPS),
        ("instrument", general, instruments, AT_INSTRUMENTS),
        ("product", list(products(s)), everywhere, {"reading": 1.0}),
        ("sight", list(sights(s)), everywhere, {"reading": 1.0}),
        ("wave", list(waves(s)), everywhere, {"reading": 0.8, "vertical index": 0.2}),
        ("swing", list(waves(s, visits=True)), stations, {"stand": 0.5, "reading": 0.5}),
        ("swing of a group", swings[:FEW_RATES], groups, {"target": 0.5, "reading": 0.5}),
        ("sway", swings, everywhere, {"stand": 0.5, "target": 0.4, "air": 0.1}),
        ("structure", bent, everywhere, {"target": 1.0}),
        ("target", [*plain, *clock], targets, AT_TARGETS),
        ("group", [*plain, *clock], groups, AT_TARGETS),
        ("tilt", across_the_room([*plain[1:], *clock], 1), groups, {"target": 1.0}),
        ("corner", [*plain, *clock], corners, AT_TARGETS),
    ]
    asked = [r for r in requests if r[1] and r[2]]
    whole = sum(SHARES[name] for name, *_ in asked)
    return [p for name, d, where, kinds in asked for p in made.panels(d, where, kinds, mass * SHARES[name] / whole)]


class _Maker:
    def __init__(self, space: ResidualSpace) -> None:
        self._s = space.sightings
        self._sigma, self._use = space.sigma, space.use
        self._known: dict[tuple[str, int], list[tuple[Carrier, Floats]]] = {}
        for carrier, design in carrier_designs(self._s).values():
            weights = np.where(self._use[:, :, None], design / self._sigma[:, :, None], 0.0)
            sized = at_noise(carrier, weights)
            self._known.setdefault((carrier.kind, len(carrier.ways)), []).append((sized, sized.size * weights))

    def panels(
        self, drivers: Sequence[Driver], places: tuple[Place, ...], kinds: Mapping[str, float], mass: float
    ) -> Iterator[Panel]:
        """Panels of carriers of a kind and drivers that move it, alike in columns and scales."""
        asked = []
        for (kind, _), known in self._known.items():
            some = [(c, w) for c, w in known if kind in kinds or c.name in kinds]
            asked += [(kind, some)] if some else []
        share = {kind: kinds.get(kind) or max(kinds.get(c.name, 0.0) for c, _ in some) for kind, some in asked}
        moved = {kind: [d for d in drivers if moves(kind, d, self._s)] for kind in share}
        whole = sum(share[kind] for kind in moved if moved[kind])
        for kind, known in asked:
            alike: dict[tuple[int, int], list[Driver]] = {}
            for driver in moved[kind]:
                alike.setdefault((driver.size, len(driver.spreads)), []).append(driver)
            carriers = sum(len(more) for other, more in asked if other == kind)
            count = carriers * len(places) * sum(len(d.spreads) for d in moved[kind])
            weights = np.stack([w for _, w in known], axis=2).astype(np.float32)
            for same in alike.values():
                columns = np.hstack([d.columns(self._s, moving=kind == "target") for d in same]).astype(np.float32)
                log_prior = float(np.log(mass * share[kind] / whole / count))
                yield Panel(tuple(c for c, _ in known), tuple(same), places, weights, columns, log_prior)


def at_noise(carrier: Carrier, weights: Floats) -> Carrier:
    """The carrier with a plausible size that at least reaches the noise: nobody models what no reading feels."""
    strength = np.sqrt(np.mean(np.sum(weights**2, axis=1), axis=1))
    felt = float(np.median(strength[strength > 0])) if (strength > 0).any() else 0.0
    return replace(carrier, size=max(carrier.size, 1.0 / felt)) if felt > 0 else carrier
