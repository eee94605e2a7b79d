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
from ltsim.diagnosis.evidence import noise_level_factor
from ltsim.diagnosis.law_batch import MAX_CACHED_COLUMN_ENTRIES, LawBatch, RegressorColumns, RowPartition
from ltsim.diagnosis.prior import CAUSE_PRIOR, PLACE_PRIOR, RESPONSE_PRIOR, RESPONSE_PRIOR_AT_TARGETS
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

MAX_SEPARATE_PLACES = 400
"""Largest number of set-ups, or targets, of a network in which each is a separate place (cost)."""
GROUPED_TARGET_COUNTS = range(12, 101)
"""Numbers of targets of networks in which groups of targets are places: fewer hardly form a group,
more cost too much.
"""
MIN_POINTINGS_PER_FINE_COEFFICIENT = 4
"""Smallest number of pointings of a set-up per coefficient for a fine curve; otherwise it is coarse."""
MIN_POINTINGS_PER_COEFFICIENT = 2
"""Smallest number of pointings on which a law acts per coefficient: the adjustment absorbs about half of their
information.
"""
PER_SETUP_REGRESSOR_KINDS = ("constant", "sign", "curve", "decay", "memory", "lag", "state", "latch")
"""Kinds of regressors of one instrument, and of one set-up."""
REGION_REGRESSOR_KINDS = ("passage", "lever", "passage for a time", "lever for a time", "near")
"""Kinds of regressors of regions of the hall."""
RESPONSE_KINDS_BY_REGRESSOR = dict.fromkeys(("product", *REGION_REGRESSOR_KINDS), ("reading",)) | {"room": ("target",)}
"""Kinds of responses that such regressors are restricted to: with others the space would be large
and hardly physical.
"""
WAVE_COVARIATES = (*CLOCK_COVARIATES, *ACCUMULATED_ROTATIONS)
"""Covariates of waves of responses other than readings."""
JOINT_REGRESSOR_KINDS = ("constant", "sign", "curve", "decay", "wave", "memory", "lag", "shape", "passage", "lever")
"""Kinds of regressors for several observables together: products of curves would have too many coefficients."""
RegressorsByKind = Mapping[str, Sequence[Regressor]]


def law_batches(space: ResidualSpace, *, with_constants: bool = True) -> list[LawBatch]:
    """Batches of laws of a recording; their priors add up to that of laws outside the catalogue.

    Constants of the instruments are included if `with_constants`; a history is compared separately. A constant
    displacement of a target is not included, because its coordinates are estimated.
    """
    made = _LawBatchBuilder(space)
    for place, where, drivers in _kinds_of_places(space):
        held = () if with_constants or place not in ("everywhere", "instrument") else ("instrument", "circle")
        made.register(place, where, drivers, ("target", *held))
    return made.law_batches()


def _kinds_of_places(space: ResidualSpace) -> list[tuple[str, tuple[LawPlace, ...], RegressorsByKind]]:
    """Kinds of places, the places, and the regressors that are tried there."""
    s = space.sightings
    everywhere = (LawPlace((), (), np.arange(len(s))),)
    stations = tuple(
        LawPlace((name,), (), rows) for name, rows in rows_by_name(_separate_names(s.station_names), s.station)
    )
    targets = tuple(
        LawPlace((), (name,), rows) for name, rows in rows_by_name(_separate_names(s.target_names), s.target)
    )
    is_grouped = len(s.target_names) in GROUPED_TARGET_COUNTS
    lengths = ((d.from_, d.to) for d in space.adjustment.recording.gauge.distance)
    sets = target_clusters(s) | neighbour_groups(s) | connected_groups(s, lengths) if is_grouped else set()
    groups = tuple(group_places(s, sets))
    stay = float(np.median([len(place.rows) for place in stations] or [0]))
    general = candidate_regressors(s)
    there = (
        general
        if stay > MIN_POINTINGS_PER_FINE_COEFFICIENT * N_MODES_DEFAULT
        else candidate_regressors(s, N_MODES_FACTOR)
    )
    swings = list(wave_regressors(s, ("station-time",), n_parts=len(s.station_names)))
    return [
        ("everywhere", everywhere, {kind: is_grouped for kind, is_grouped in general.items() if kind != "clock"}),
        ("set-up", stations, {kind: there[kind] for kind in PER_SETUP_REGRESSOR_KINDS} | {"wave": swings}),
        (
            "instrument",
            instrument_places(s, space.adjustment.recording.instruments),
            {k: general[k] for k in PER_SETUP_REGRESSOR_KINDS},
        ),
        ("target", targets, {"constant": general["constant"], "clock": general["clock"], "amounts": visits(s, 2)}),
        ("group", groups, target_group_regressors(s) if groups else {}),
    ]


def _separate_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names that are tried separately; empty for a single one, and for too many."""
    return names if 1 < len(names) <= MAX_SEPARATE_PLACES else ()


class _LawBatchBuilder:
    """Builder of law batches: laws that differ only in their place are scored together."""

    def __init__(self, space: ResidualSpace) -> None:
        self._sightings = space.sightings
        self._sigma, self._is_used = space.sigma, space.used_readings
        self._responses: dict[tuple[str, int], list[tuple[Response, Floats]]] = {}
        self._registered: dict[
            tuple[tuple[Response, ...], tuple[Regressor, ...]], list[tuple[tuple[LawPlace, ...], float]]
        ] = {}
        for carrier, design in response_designs(self._sightings).values():
            weights = np.where(self._is_used[:, :, None], design / self._sigma[:, :, None], 0.0)
            sized = scaled_to_noise(carrier, weights)
            self._responses.setdefault((carrier.kind, len(carrier.component_names)), []).append(
                (sized, sized.plausible_size * weights)
            )

    def register(
        self,
        place: str,
        places: tuple[LawPlace, ...],
        regressors_by_kind: RegressorsByKind,
        excluded_kinds: tuple[str, ...],
    ) -> None:
        """Registration of laws at some places, of responses and of their regressors.

        Some kinds are excluded (`excluded_kinds`).
        """
        kinds = RESPONSE_PRIOR_AT_TARGETS if place in ("target", "group") else RESPONSE_PRIOR
        for (kind, ways), carriers_of_kind in self._responses.items():
            together = len(carriers_of_kind[0][0].component_units)  # observables of a joint response; 0 for all others
            carriers = sum(
                len(same)
                for (other, n), same in self._responses.items()
                if other == kind and (n == ways if together else not same[0][0].component_units)
            )
            for name, drivers in regressors_by_kind.items():
                if (
                    kind not in kinds
                    or kind not in RESPONSE_KINDS_BY_REGRESSOR.get(name, (kind,))
                    or (name == "constant" and kind in excluded_kinds)
                ):
                    continue
                if together and (name not in JOINT_REGRESSOR_KINDS or place in ("target", "group")):
                    continue
                moved = [
                    d
                    for d in drivers
                    if is_admissible(kind, d, self._sightings) and (name != "wave" or _is_wave_candidate(kind, d))
                ]
                depth = OPERATOR_COUNTS[name] + max(together - 1, 0)
                weight = PLACE_PRIOR[place] * kinds[kind] * OPERATOR_ODDS**depth / carriers
                self._divide_weight(
                    tuple(c for c, _ in carriers_of_kind if _changes_with_region(name, c)), moved, places, weight, ways
                )

    def _divide_weight(
        self,
        responses: tuple[Response, ...],
        regressors: Sequence[Regressor],
        places: tuple[LawPlace, ...],
        weight: float,
        n_components: int,
    ) -> None:
        """Division of the weight of each response equally among regressors and the places with enough pointings."""
        by_shape: dict[tuple[int, int], list[Regressor]] = {}
        for driver in regressors if responses else ():
            by_shape.setdefault((driver.n_columns, len(driver.coefficient_sigmas)), []).append(driver)
        fit = {
            k: tuple(p for p in places if len(p.rows) >= MIN_POINTINGS_PER_COEFFICIENT * k[0] * n_components)
            for k in by_shape
        }
        count = sum(len(members) * scales * len(fit[k, scales]) for (k, scales), members in by_shape.items())
        for size, same in by_shape.items():
            if fit[size]:
                self._registered.setdefault((responses, tuple(same)), []).append((fit[size], weight / count))

    def law_batches(self) -> list[LawBatch]:
        """Batches of the registered laws: equal responses and regressors at all their places in one batch."""
        weights = {c: w for carriers_of_kind in self._responses.values() for c, w in carriers_of_kind}
        whole = sum(
            prior * len(group) * len(carriers) * sum(len(d.coefficient_sigmas) for d in drivers)
            for (carriers, drivers), wanted in self._registered.items()
            for group, prior in wanted
        )
        cells: dict[tuple[int, ...], RowPartition] = {}
        stacked: dict[tuple[Response, ...], Singles] = {}
        columns: dict[tuple[tuple[Regressor, ...], bool, tuple[int, ...]], RegressorColumns] = {}
        batches = []
        for (carriers, drivers), wanted in self._registered.items():
            places = tuple(place for group, _ in wanted for place in group)
            same = tuple(id(place) for place in places)
            if same not in cells:
                cells[same] = RowPartition.from_places(places, len(self._sightings))
            if carriers not in stacked:
                stacked[carriers] = np.stack([weights[c] for c in carriers], axis=2, dtype=np.float32)
            key = drivers, carriers[0].kind == "target", same
            if key not in columns:
                columns[key] = RegressorColumns(drivers, self._sightings, cells[same].order, acts_on_targets=key[1])
            share = np.concatenate([np.full(len(group), prior / whole) for group, prior in wanted])
            batches.append(
                LawBatch(
                    carriers,
                    drivers,
                    places,
                    cells[same],
                    stacked[carriers],
                    columns[key],
                    np.log(CAUSE_PRIOR["law"] * share),
                )
            )
        entries = sum(shared.n_entries_per_regressor * len(drivers) for (drivers, _, _), shared in columns.items())
        for shared in columns.values():
            shared.is_cached = entries <= MAX_CACHED_COLUMN_ENTRIES
        return batches


def _changes_with_region(name: str, response: Response) -> bool:
    """True unless a region changes the response in another way: ranges by the path in it, angles by its lever."""
    way = name.removesuffix(" for a time")
    return way not in ("passage", "lever") or ("distance" in response.observables) == (way == "passage")


def _is_wave_candidate(kind: str, wave: Regressor) -> bool:
    """True if a wave is a candidate for a kind of response: readings with any covariate, others with the work done."""
    return kind == "reading" or wave.covariates[0] in WAVE_COVARIATES


def scaled_to_noise(response: Response, weights: Floats) -> Response:
    """Response with a plausible size that at least reaches the noise; `weights` (n, 3, c) belong to its unit."""
    strength = response.plausible_size * np.sqrt(np.mean(np.sum(weights**2, axis=1), axis=1))
    return replace(response, plausible_size=response.plausible_size * noise_level_factor(strength))
