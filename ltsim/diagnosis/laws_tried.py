"""Which laws are tried in a recording: carriers, drivers and places, and how the prior is shared among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.diagnosis.panel import Cells, Panel
from ltsim.diagnosis.prior import AT_INSTRUMENTS, AT_SET_UPS, AT_TARGETS, KINDS, LAWS, PRIOR
from ltsim.laws.carriers import Carrier, carrier_designs
from ltsim.laws.columns import LOW, MODES
from ltsim.laws.drivers import CONSTANT, Driver, across_the_room, simple, smooth
from ltsim.laws.offered import further, general_drivers, lags, moves, products, sights, visits, waves
from ltsim.laws.places import Place, branches, corners_of, each, together, trackers_of

MOST_PLACES = 400
"""Set-ups, or targets, up to whose number each is tried on its own."""
GROUPED = range(12, 101)
"""Numbers of targets with which groups of them are tried: few make hardly a group, of many there are too many."""
ROOM = 4
"""Pointings of a visit for each coefficient of a fine curve; with fewer a coarse one is tried."""
FEW_RATES = 18
"""Rates of waves, the slowest ones, that a group of targets is tried with."""
Request = tuple[str, Sequence[Driver], tuple[Place, ...], Mapping[str, float]]
"""A share of `LAWS`, and the drivers, places, and kinds or names of carriers, among which it is shared."""


def panels(space: ResidualSpace) -> list[Panel]:
    """All panels of a recording; their priors sum to that of laws without a card."""
    asked = [request for request in _requests(space) if request[1] and request[2]]
    whole = sum(LAWS[share] for share, *_ in asked)
    made = _Maker(space)
    for share, drivers, where, kinds in asked:
        made.ask(drivers, where, kinds, PRIOR["law"] * LAWS[share] / whole)
    return made.panels()


def _requests(space: ResidualSpace) -> list[Request]:
    """How the prior of laws without a card is shared: what is offered here takes all of it."""
    s = space.sightings
    everywhere = (Place((), (), np.arange(len(s))),)
    stations = tuple(Place((name,), (), rows) for name, rows in each(_few(s.station_names), s.station))
    targets = tuple(Place((), (name,), rows) for name, rows in each(_few(s.target_names), s.target))
    instruments = trackers_of(s, space.adjustment.recording.instruments)
    some = len(s.target_names) in GROUPED
    groups, corners = (tuple(together(s, sets(s))) if some else () for sets in (branches, corners_of))
    general = general_drivers(s)
    stay = float(np.median([len(place.rows) for place in stations] or [0]))
    there = general if stay > ROOM * MODES else general_drivers(s, LOW)
    clock = [smooth(n, LOW) for n in ("time", *further(s)) if np.ptp(s.quantities[n]) > 0]
    plain = [simple(n, "power") for n in ("time", "distance", "elevation") if np.ptp(s.quantities[n]) > 0]
    plain += [*(simple(n, "power") for n in further(s)), *lags(s, further(s))]
    local = [CONSTANT, *plain, *clock]
    swinging = list(waves(s))
    swings, of_visits = [d for d in swinging if d.covariates == ("time",)], list(waves(s, of_a_visit=True))
    bent = [*across_the_room(swings, 1), *across_the_room([*clock, *plain], 2)]
    tilting = across_the_room([*plain, *clock, *visits(s)], 1)
    reading = {"reading": 1.0}
    return [
        ("everywhere", general, everywhere, KINDS),
        ("set-up", there, stations, AT_SET_UPS),
        ("instrument", general, instruments, AT_INSTRUMENTS),
        ("two drivers", list(products(s)), everywhere, reading),
        ("on the way", list(sights(s)), everywhere, reading),
        ("reading that swings", swinging, everywhere, {"reading": 0.8, "vertical index": 0.2}),
        ("set-up that swings", of_visits, stations, {"stand": 0.5, "reading": 0.5}),
        ("group that swings", swings[:FEW_RATES], groups, {"target": 0.5, "reading": 0.5}),
        ("anything else that swings", swings, everywhere, {"stand": 0.5, "target": 0.4, "air": 0.1}),
        ("across the room", bent, everywhere, {"target": 1.0}),
        ("target", local, targets, AT_TARGETS),
        ("group", [*local, *visits(s)], groups, AT_TARGETS),
        ("group that tilts", tilting, groups, {"target": 1.0}),
        ("corner", local, corners, AT_TARGETS),
    ]


def _few(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of which each is tried on its own: none where there is one, or too many."""
    return names if 1 < len(names) <= MOST_PLACES else ()


class _Maker:
    """Panels in the making: laws that are alike but for their place are scored together."""

    def __init__(self, space: ResidualSpace) -> None:
        self._s = space.sightings
        self._sigma, self._use = space.sigma, space.use
        self._known: dict[tuple[str, int], list[tuple[Carrier, Floats]]] = {}
        self._asked: dict[tuple[tuple[Carrier, ...], tuple[Driver, ...]], list[tuple[tuple[Place, ...], float]]] = {}
        for carrier, design in carrier_designs(self._s).values():
            weights = np.where(self._use[:, :, None], design / self._sigma[:, :, None], 0.0)
            sized = at_noise(carrier, weights)
            self._known.setdefault((carrier.kind, len(carrier.ways)), []).append((sized, sized.size * weights))

    def ask(
        self, drivers: Sequence[Driver], places: tuple[Place, ...], kinds: Mapping[str, float], mass: float
    ) -> None:
        """Ask for panels of carriers of a kind and drivers that move it, alike in columns and scales."""
        asked = []
        for (kind, _), known in self._known.items():
            some = tuple(c for c, _ in known if kind in kinds or c.name in kinds)
            asked += [(kind, some)] if some else []
        share = {kind: kinds.get(kind) or max(kinds.get(c.name, 0.0) for c in some) for kind, some in asked}
        moved = {kind: [d for d in drivers if moves(kind, d, self._s)] for kind in share}
        whole = sum(share[kind] for kind in moved if moved[kind])
        for kind, some in asked:
            alike: dict[tuple[int, int], list[Driver]] = {}
            for driver in moved[kind]:
                alike.setdefault((driver.size, len(driver.spreads)), []).append(driver)
            carriers = sum(len(more) for other, more in asked if other == kind)
            count = carriers * len(places) * sum(len(d.spreads) for d in moved[kind])
            for same in alike.values():
                log_prior = float(np.log(mass * share[kind] / whole / count))
                self._asked.setdefault((some, tuple(same)), []).append((places, log_prior))

    def panels(self) -> list[Panel]:
        """What was asked for: the same carriers and drivers at all their places in one panel."""
        weights = {c: w for known in self._known.values() for c, w in known}
        cells: dict[tuple[int, ...], Cells] = {}
        found = []
        for (carriers, drivers), wanted in self._asked.items():
            places = tuple(place for some, _ in wanted for place in some)
            same = tuple(id(some) for some, _ in wanted)
            if same not in cells:
                cells[same] = Cells.of(places, len(self._s))
            columns = [d.columns(self._s, moving=carriers[0].kind == "target") for d in drivers]
            found.append(
                Panel(
                    carriers,
                    drivers,
                    places,
                    cells[same],
                    weights=np.stack([weights[c] for c in carriers], axis=2, dtype=np.float32),
                    columns=np.hstack(columns, dtype=np.float32)[cells[same].order],
                    log_prior=np.concatenate([np.full(len(some), prior) for some, prior in wanted]),
                )
            )
        return found


def at_noise(carrier: Carrier, weights: Floats) -> Carrier:
    """The carrier with a plausible size that at least reaches the noise: nobody models what no reading feels."""
    strength = np.sqrt(np.mean(np.sum(weights**2, axis=1), axis=1))
    felt = float(np.median(strength[strength > 0])) if (strength > 0).any() else 0.0
    return replace(carrier, size=max(carrier.size, 1.0 / felt)) if felt > 0 else carrier
