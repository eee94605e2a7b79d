"""Search space of laws (responses x regressors x places), and the division of the prior among them.

The prior odds of a law are the product of those of its place, of the kind of its response and of its regressor; each is
divided equally among all of its kind in the recording, and the total is normalised to the prior of laws outside the
catalogue.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats, Singles
from ltsim.diagnosis.evidence import times_to_noise
from ltsim.diagnosis.law_batch import LawBatch, RegressorColumns, RowPartition
from ltsim.diagnosis.prior import AT_TARGETS, KINDS, PLACES, PRIOR
from ltsim.physics.laws.columns import N_MODES_DEFAULT, N_MODES_FACTOR
from ltsim.physics.laws.places import (
    LawPlace,
    connected_groups,
    group_places,
    instrument_places,
    neighbour_groups,
    rows_by_name,
    target_clusters,
)
from ltsim.physics.laws.regressor_library import (
    ACCUMULATED_ROTATIONS,
    OPERATOR_COUNTS,
    OPERATOR_ODDS,
    candidate_regressors,
    is_admissible,
    target_group_regressors,
    visits,
    wave_regressors,
)
from ltsim.physics.laws.regressors import CLOCK_COVARIATES, Regressor
from ltsim.physics.laws.responses import Response, response_designs

MOST_PLACES = 400
"""Largest number of set-ups, or targets, of a network in which each is a separate place (cost)."""
GROUPED = range(12, 101)
"""Numbers of targets of networks in which groups of targets are places: fewer hardly form a group,
more cost too much.
"""
FINE = 4
"""Smallest number of pointings of a set-up per coefficient for a fine curve; otherwise it is coarse."""
ROOM = 2
"""Smallest number of pointings per coefficient at the place of a law: the adjustment absorbs about half of them."""
AT_A_TIME = ("constant", "sign", "curve", "decay", "memory", "lag", "state", "latch")
"""Kinds of regressors of one instrument, and of one set-up."""
IN_THE_HALL = ("passage", "lever", "passage for a time", "lever for a time", "near")
"""Kinds of regressors of regions of the hall."""
ONLY = dict.fromkeys(("product", *IN_THE_HALL), ("reading",)) | {"room": ("target",)}
"""Kinds of responses that such regressors are restricted to: with others the space would be large
and hardly physical.
"""
SWINGS = (*CLOCK_COVARIATES, *ACCUMULATED_ROTATIONS)
"""Covariates of waves of responses other than readings."""
TOGETHER = ("constant", "sign", "curve", "decay", "wave", "memory", "lag", "shape", "passage", "lever")
"""Kinds of regressors for several observables together: products of curves would have too many coefficients."""
MAX_CACHED = 10_000_000
"""Largest number of entries of the columns of all regressors that stay in memory, 40 MB; computing them anew takes a
sixth of the time of a scoring.
"""
Drivers = Mapping[str, Sequence[Regressor]]


def panels(space: ResidualSpace, *, ordinary: bool = True) -> list[LawBatch]:
    """Batches of laws of a recording; their priors add up to that of laws outside the catalogue.

    Constants of the instruments are included if `ordinary`; a history is compared separately. A constant displacement
    of a target is not included, because its coordinates are estimated.
    """
    made = _Maker(space)
    for place, where, drivers in _places(space):
        held = () if ordinary or place not in ("everywhere", "instrument") else ("instrument", "circle")
        made.ask(place, where, drivers, ("target", *held))
    return made.panels()


def _places(space: ResidualSpace) -> list[tuple[str, tuple[LawPlace, ...], Drivers]]:
    """Kinds of places, the places, and the regressors that are tried there."""
    s = space.sightings
    everywhere = (LawPlace((), (), np.arange(len(s))),)
    stations = tuple(LawPlace((name,), (), rows) for name, rows in rows_by_name(_few(s.station_names), s.station))
    targets = tuple(LawPlace((), (name,), rows) for name, rows in rows_by_name(_few(s.target_names), s.target))
    is_grouped = len(s.target_names) in GROUPED
    lengths = ((d.from_, d.to) for d in space.adjustment.recording.gauge.distance)
    sets = target_clusters(s) | neighbour_groups(s) | connected_groups(s, lengths) if is_grouped else set()
    groups = tuple(group_places(s, sets))
    stay = float(np.median([len(place.rows) for place in stations] or [0]))
    general = candidate_regressors(s)
    there = general if stay > FINE * N_MODES_DEFAULT else candidate_regressors(s, N_MODES_FACTOR)
    swings = list(wave_regressors(s, ("station-time",), n_parts=len(s.station_names)))
    return [
        ("everywhere", everywhere, {kind: is_grouped for kind, is_grouped in general.items() if kind != "clock"}),
        ("set-up", stations, {kind: there[kind] for kind in AT_A_TIME} | {"wave": swings}),
        (
            "instrument",
            instrument_places(s, space.adjustment.recording.instruments),
            {k: general[k] for k in AT_A_TIME},
        ),
        ("target", targets, {"constant": general["constant"], "clock": general["clock"], "amounts": visits(s, 2)}),
        ("group", groups, target_group_regressors(s) if groups else {}),
    ]


def _few(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names that are tried separately; empty for a single one, and for too many."""
    return names if 1 < len(names) <= MOST_PLACES else ()


class _Maker:
    """Builder of law batches: laws that differ only in their place are scored together."""

    def __init__(self, space: ResidualSpace) -> None:
        self._s = space.sightings
        self._sigma, self._use = space.sigma, space.used_readings
        self._carriers: dict[tuple[str, int], list[tuple[Response, Floats]]] = {}
        self._asked: dict[
            tuple[tuple[Response, ...], tuple[Regressor, ...]], list[tuple[tuple[LawPlace, ...], float]]
        ] = {}
        for carrier, design in response_designs(self._s).values():
            weights = np.where(self._use[:, :, None], design / self._sigma[:, :, None], 0.0)
            sized = scaled_to_noise(carrier, weights)
            self._carriers.setdefault((carrier.kind, len(carrier.component_names)), []).append(
                (sized, sized.plausible_size * weights)
            )

    def ask(self, place: str, places: tuple[LawPlace, ...], offered: Drivers, held: tuple[str, ...]) -> None:
        """Registration of laws at some places, of responses and of their regressors.

        Some kinds are excluded (`held`).
        """
        kinds = AT_TARGETS if place in ("target", "group") else KINDS
        for (kind, ways), carriers_of_kind in self._carriers.items():
            together = len(carriers_of_kind[0][0].component_units)  # observables of a joint response; 0 for all others
            carriers = sum(
                len(same)
                for (other, n), same in self._carriers.items()
                if other == kind and (n == ways if together else not same[0][0].component_units)
            )
            for name, drivers in offered.items():
                if kind not in kinds or kind not in ONLY.get(name, (kind,)) or (name == "constant" and kind in held):
                    continue
                if together and (name not in TOGETHER or place in ("target", "group")):
                    continue
                moved = [d for d in drivers if is_admissible(kind, d, self._s) and (name != "wave" or _swings(kind, d))]
                depth = OPERATOR_COUNTS[name] + max(together - 1, 0)
                weight = PLACES[place] * kinds[kind] * OPERATOR_ODDS**depth / carriers
                self._share(tuple(c for c, _ in carriers_of_kind if _passes(name, c)), moved, places, weight, ways)

    def _share(
        self,
        carriers: tuple[Response, ...],
        drivers: Sequence[Regressor],
        places: tuple[LawPlace, ...],
        weight: float,
        ways: int,
    ) -> None:
        """Division of the weight of each response equally among regressors and the places with enough pointings."""
        by_shape: dict[tuple[int, int], list[Regressor]] = {}
        for driver in drivers if carriers else ():
            by_shape.setdefault((driver.n_columns, len(driver.coefficient_sigmas)), []).append(driver)
        fit = {k: tuple(p for p in places if len(p.rows) >= ROOM * k[0] * ways) for k in by_shape}
        count = sum(len(members) * scales * len(fit[k, scales]) for (k, scales), members in by_shape.items())
        for size, same in by_shape.items():
            if fit[size]:
                self._asked.setdefault((carriers, tuple(same)), []).append((fit[size], weight / count))

    def panels(self) -> list[LawBatch]:
        """Batches of the registered laws: equal responses and regressors at all their places in one batch."""
        weights = {c: w for carriers_of_kind in self._carriers.values() for c, w in carriers_of_kind}
        whole = sum(
            prior * len(group) * len(carriers) * sum(len(d.coefficient_sigmas) for d in drivers)
            for (carriers, drivers), wanted in self._asked.items()
            for group, prior in wanted
        )
        cells: dict[tuple[int, ...], RowPartition] = {}
        stacked: dict[tuple[Response, ...], Singles] = {}
        columns: dict[tuple[tuple[Regressor, ...], bool, tuple[int, ...]], RegressorColumns] = {}
        batches = []
        for (carriers, drivers), wanted in self._asked.items():
            places = tuple(place for group, _ in wanted for place in group)
            same = tuple(id(place) for place in places)
            if same not in cells:
                cells[same] = RowPartition.of(places, len(self._s))
            if carriers not in stacked:
                stacked[carriers] = np.stack([weights[c] for c in carriers], axis=2, dtype=np.float32)
            key = drivers, carriers[0].kind == "target", same
            if key not in columns:
                columns[key] = RegressorColumns(drivers, self._s, cells[same].order, moving=key[1])
            share = np.concatenate([np.full(len(group), prior / whole) for group, prior in wanted])
            batches.append(
                LawBatch(
                    carriers,
                    drivers,
                    places,
                    cells[same],
                    stacked[carriers],
                    columns[key],
                    np.log(PRIOR["law"] * share),
                )
            )
        entries = sum(shared.entries * len(drivers) for (drivers, _, _), shared in columns.items())
        for shared in columns.values():
            shared.cached = entries <= MAX_CACHED
        return batches


def _passes(name: str, carrier: Response) -> bool:
    """True unless a region changes the response in another way: ranges by the path in it, angles by its lever."""
    way = name.removesuffix(" for a time")
    return way not in ("passage", "lever") or ("distance" in carrier.observables) == (way == "passage")


def _swings(kind: str, wave: Regressor) -> bool:
    """True if a wave is a candidate for a kind of response: readings with any covariate, others with the work done."""
    return kind == "reading" or wave.covariates[0] in SWINGS


def scaled_to_noise(carrier: Response, weights: Floats) -> Response:
    """Response with a plausible size that at least reaches the noise; `weights` (n, 3, c) belong to its unit."""
    strength = carrier.plausible_size * np.sqrt(np.mean(np.sum(weights**2, axis=1), axis=1))
    return replace(carrier, plausible_size=carrier.plausible_size * times_to_noise(strength))
