"""Which laws are tried in a recording: carriers, drivers and places, and how the prior is shared among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.diagnosis.panel import Cells, Panel
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
Request = tuple[float, Sequence[Driver], tuple[Place, ...], Mapping[str, float]]
"""A share of the prior, and the drivers, places, and kinds or names of carriers, among which it is shared."""


def panels(space: ResidualSpace, mass: float) -> list[Panel]:
    """All panels of a recording; their priors sum to `mass`."""
    asked = [request for request in _requests(space) if request[1] and request[2]]
    whole = sum(share for share, *_ in asked)
    made = _Maker(space)
    for share, drivers, where, kinds in asked:
        made.ask(drivers, where, kinds, mass * share / whole)
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
        (0.35, general, everywhere, KINDS),  # any carrier, any driver, the whole recording
        (0.15, there, stations, AT_SET_UPS),  # the same at one set-up
        (0.10, general, instruments, AT_INSTRUMENTS),  # the same at all set-ups of one instrument
        (0.12, list(products(s)), everywhere, reading),  # a reading that follows two drivers
        (0.03, list(sights(s)), everywhere, reading),  # that errs on the way to the target, or a list one row late
        (0.08, swinging, everywhere, {"reading": 0.8, "vertical index": 0.2}),  # a reading that swings
        (0.02, of_visits, stations, {"stand": 0.5, "reading": 0.5}),  # one set-up that swings in time
        (0.02, swings[:FEW_RATES], groups, {"target": 0.5, "reading": 0.5}),  # targets that belong together that do
        (0.02, swings, everywhere, {"stand": 0.5, "target": 0.4, "air": 0.1}),  # anything else that swings in time
        (0.04, bent, everywhere, {"target": 1.0}),  # targets that move together, more the farther across the room
        (0.04, local, targets, AT_TARGETS),  # one target
        (0.02, [*local, *visits(s)], groups, AT_TARGETS),  # targets that belong together
        (0.04, tilting, groups, {"target": 1.0}),  # the same, more the farther across the group
        (0.02, local, corners, AT_TARGETS),  # a target and those around it
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
