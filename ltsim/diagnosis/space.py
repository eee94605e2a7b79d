"""The space that is searched: carriers x drivers x places, and how the prior is shared among them.

A law has the odds of its place, of the kind of its carrier and of its driver, multiplied; each is shared evenly among
all of its kind that the recording offers, and the whole is normalised to the prior of laws outside the catalogue.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.diagnosis.evidence import times_to_noise
from ltsim.diagnosis.law_batch import LawBatch, RowPartition
from ltsim.diagnosis.prior import AT_TARGETS, KINDS, PLACES, PRIOR
from ltsim.physics.laws.columns import LOW, MODES
from ltsim.physics.laws.places import (
    Place,
    clusters,
    connected_groups,
    each,
    group_places,
    neighbour_groups,
    trackers_of,
)
from ltsim.physics.laws.regressor_library import (
    DEPTHS,
    OPERATOR_ODDS,
    WORK,
    group_drivers,
    is_admissible,
    regressors_of,
    waves,
)
from ltsim.physics.laws.regressors import CLOCKS, Regressor
from ltsim.physics.laws.responses import ResponseTerm, response_designs

MOST_PLACES = 400
"""Each set-up, or target, is a place of its own in networks of at most this many (cost)."""
GROUPED = range(12, 101)
"""Groups of targets are places in networks with this many targets: fewer hardly form a group, more cost too much."""
FINE = 4
"""A curve is fine if a set-up has more pointings per coefficient than this, else coarse."""
ROOM = 2
"""A law needs this many pointings per coefficient at its place: the adjustment absorbs about half of them."""
AT_A_TIME = ("constant", "sign", "curve", "decay", "memory", "lag", "state", "latch")
"""Kinds of drivers of one instrument, and of one set-up."""
IN_THE_HALL = ("passage", "lever", "passage for a time", "lever for a time", "near")
"""Kinds of drivers of regions of the hall."""
ONLY = dict.fromkeys(("product", *IN_THE_HALL), ("reading",)) | {"room": ("target",)}
"""Kinds of carriers that alone have such drivers: of others the space would be large and hardly physical."""
SWINGS = (*CLOCKS, *WORK)
"""Covariates of waves of other responses than readings."""
TOGETHER = ("constant", "sign", "curve", "decay", "wave", "memory", "lag", "shape", "passage", "lever")
"""Kinds of drivers that several observables follow together: products of curves would have too many coefficients."""
Drivers = Mapping[str, Sequence[Regressor]]


def panels(space: ResidualSpace, *, ordinary: bool = True) -> list[LawBatch]:
    """All batches of laws of a recording; their priors sum to that of laws outside the catalogue.

    Constants of the instruments are among them as long as they are `ordinary`: a history is compared with by itself. A
    constant displacement of a target is none: its coordinates are estimated.
    """
    made = _Maker(space)
    for place, where, drivers in _places(space):
        held = () if ordinary or place not in ("everywhere", "instrument") else ("instrument", "circle")
        made.ask(place, where, drivers, ("target", *held))
    return made.panels()


def _places(space: ResidualSpace) -> list[tuple[str, tuple[Place, ...], Drivers]]:
    """Kinds of places, the places, and the drivers that are tried there."""
    s = space.sightings
    everywhere = (Place((), (), np.arange(len(s))),)
    stations = tuple(Place((name,), (), rows) for name, rows in each(_few(s.station_names), s.station))
    targets = tuple(Place((), (name,), rows) for name, rows in each(_few(s.target_names), s.target))
    is_grouped = len(s.target_names) in GROUPED
    lengths = ((d.from_, d.to) for d in space.adjustment.recording.gauge.distance)
    sets = clusters(s) | neighbour_groups(s) | connected_groups(s, lengths) if is_grouped else set()
    groups = tuple(group_places(s, sets))
    stay = float(np.median([len(place.rows) for place in stations] or [0]))
    general = regressors_of(s)
    there = general if stay > FINE * MODES else regressors_of(s, LOW)
    swings = list(waves(s, ("station-time",), among=len(s.station_names)))
    return [
        ("everywhere", everywhere, {kind: is_grouped for kind, is_grouped in general.items() if kind != "clock"}),
        ("set-up", stations, {kind: there[kind] for kind in AT_A_TIME} | {"wave": swings}),
        ("instrument", trackers_of(s, space.adjustment.recording.instruments), {k: general[k] for k in AT_A_TIME}),
        ("target", targets, {"constant": general["constant"], "clock": general["clock"]}),
        ("group", groups, group_drivers(s) if groups else {}),
    ]


def _few(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of which each is tried on its own: none where there is one, or too many."""
    return names if 1 < len(names) <= MOST_PLACES else ()


class _Maker:
    """Builder of law batches: laws that differ only in their place are scored together."""

    def __init__(self, space: ResidualSpace) -> None:
        self._s = space.sightings
        self._sigma, self._use = space.sigma, space.use
        self._carriers: dict[tuple[str, int], list[tuple[ResponseTerm, Floats]]] = {}
        self._asked: dict[
            tuple[tuple[ResponseTerm, ...], tuple[Regressor, ...]], list[tuple[tuple[Place, ...], float]]
        ] = {}
        for carrier, design in response_designs(self._s).values():
            weights = np.where(self._use[:, :, None], design / self._sigma[:, :, None], 0.0)
            sized = scaled_to_noise(carrier, weights)
            self._carriers.setdefault((carrier.kind, len(carrier.ways)), []).append((sized, sized.size * weights))

    def ask(self, place: str, places: tuple[Place, ...], offered: Drivers, held: tuple[str, ...]) -> None:
        """Ask for panels at some places, of carriers and of the drivers that move them; some kinds are `held`."""
        kinds = AT_TARGETS if place in ("target", "group") else KINDS
        for (kind, ways), carriers_of_kind in self._carriers.items():
            together = len(carriers_of_kind[0][0].units)  # observables of a joint response; 0 for all others
            carriers = sum(
                len(same)
                for (other, n), same in self._carriers.items()
                if other == kind and (n == ways if together else not same[0][0].units)
            )
            for name, drivers in offered.items():
                if kind not in kinds or kind not in ONLY.get(name, (kind,)) or (name == "constant" and kind in held):
                    continue
                if together and (name not in TOGETHER or place in ("target", "group")):
                    continue
                moved = [d for d in drivers if is_admissible(kind, d, self._s) and (name != "wave" or _swings(kind, d))]
                depth = DEPTHS[name] + max(together - 1, 0)
                weight = PLACES[place] * kinds[kind] * OPERATOR_ODDS**depth / carriers
                self._share(tuple(c for c, _ in carriers_of_kind if _passes(name, c)), moved, places, weight, ways)

    def _share(
        self,
        carriers: tuple[ResponseTerm, ...],
        drivers: Sequence[Regressor],
        places: tuple[Place, ...],
        weight: float,
        ways: int,
    ) -> None:
        """Share a weight for each carrier evenly among drivers and the places that have room for them."""
        by_shape: dict[tuple[int, int], list[Regressor]] = {}
        for driver in drivers if carriers else ():
            by_shape.setdefault((driver.size, len(driver.spreads)), []).append(driver)
        fit = {k: tuple(p for p in places if len(p.rows) >= ROOM * k[0] * ways) for k in by_shape}
        count = sum(len(members) * scales * len(fit[k, scales]) for (k, scales), members in by_shape.items())
        for size, same in by_shape.items():
            if fit[size]:
                self._asked.setdefault((carriers, tuple(same)), []).append((fit[size], weight / count))

    def panels(self) -> list[LawBatch]:
        """Panels of the requested laws: the same carriers and drivers at all their places in one panel."""
        weights = {c: w for carriers_of_kind in self._carriers.values() for c, w in carriers_of_kind}
        whole = sum(
            prior * len(group) * len(carriers) * sum(len(d.spreads) for d in drivers)
            for (carriers, drivers), wanted in self._asked.items()
            for group, prior in wanted
        )
        cells: dict[tuple[int, ...], RowPartition] = {}
        batches = []
        for (carriers, drivers), wanted in self._asked.items():
            places = tuple(place for group, _ in wanted for place in group)
            same = tuple(id(place) for place in places)
            if same not in cells:
                cells[same] = RowPartition.of(places, len(self._s))
            columns = [d.columns(self._s, moving=carriers[0].kind == "target") for d in drivers]
            share = np.concatenate([np.full(len(group), prior / whole) for group, prior in wanted])
            batches.append(
                LawBatch(
                    carriers,
                    drivers,
                    places,
                    cells[same],
                    weights=np.stack([weights[c] for c in carriers], axis=2, dtype=np.float32),
                    columns=np.hstack(columns, dtype=np.float32)[cells[same].order],
                    log_prior=np.log(PRIOR["law"] * share),
                )
            )
        return batches


def _passes(name: str, carrier: ResponseTerm) -> bool:
    """True unless a region changes the response in another way: ranges by the path in it, angles by its lever."""
    way = name.removesuffix(" for a time")
    return way not in ("passage", "lever") or ("distance" in carrier.observables) == (way == "passage")


def _swings(kind: str, wave: Regressor) -> bool:
    """True if a wave is a candidate for a kind of response: readings with any covariate, others with the work done."""
    return kind == "reading" or wave.covariates[0] in SWINGS


def scaled_to_noise(carrier: ResponseTerm, weights: Floats) -> ResponseTerm:
    """The carrier with a plausible size that at least reaches the noise; `weights` (n, 3, c) are of its unit."""
    strength = carrier.size * np.sqrt(np.mean(np.sum(weights**2, axis=1), axis=1))
    return replace(carrier, size=carrier.size * times_to_noise(strength))
