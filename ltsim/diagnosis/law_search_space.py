"""Search space of empirical laws, and their prior probabilities; a law is a response, a regressor and a place.

The response is the quantity that the law changes, such as the vertical index. The regressor is a function of
covariates, such as a curve over time, on which the response depends. The place is the stations, targets or instruments
where the law acts.

The prior odds of a law are the product of the odds of its place, its response and its regressor. The odds of a kind of
place are divided equally among all places of this kind in the recording, and likewise for responses and regressors. The
sum over all laws is then normalised to the prior probability of a law outside the catalogue.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats, Floats32
from ltsim.diagnosis.evidence import size_factor_to_noise_level
from ltsim.diagnosis.law_batch import MAX_CACHED_COLUMN_ENTRIES, LawBatch, PointingPartition, RegressorColumns
from ltsim.diagnosis.prior import (
    PRIOR_PROBABILITY_BY_CAUSE_CLASS,
    PRIOR_PROBABILITY_BY_PLACE_KIND,
    PRIOR_PROBABILITY_BY_RESPONSE_KIND,
    PRIOR_PROBABILITY_BY_RESPONSE_KIND_AT_TARGETS,
)
from ltsim.physics.laws.columns import N_CURVE_MODES, N_PRODUCT_CURVE_MODES
from ltsim.physics.laws.places import (
    LawPlace,
    group_places,
    groups_connected_by_lengths,
    instrument_places,
    names_and_rows,
    neighbour_groups,
    target_clusters,
)
from ltsim.physics.laws.regressor_library import (
    ACCUMULATED_ROTATIONS,
    N_OPERATORS_BY_REGRESSOR_KIND,
    ODDS_PER_OPERATOR,
    candidate_regressors,
    is_physically_possible,
    per_setup_regressors,
    regressors_for_target_groups,
    wave_regressors,
)
from ltsim.physics.laws.regressors import CLOCK_COVARIATES, Regressor
from ltsim.physics.laws.responses import Response, response_designs

MAX_SEPARATE_SETUPS_OR_TARGETS = 400
"""Largest number of set-ups (or targets) with which empirical laws (errors as functions of covariates) at single
set-ups (or targets) are tried. The limit keeps the computing time short."""
TARGET_COUNTS_FOR_GROUP_LAWS = range(12, 101)
"""Numbers of targets in a network with which empirical laws (errors as functions of covariates) at a group of targets
are tried. Fewer targets hardly form a group, and more targets take too much computing time."""
MIN_POINTINGS_PER_COEFFICIENT_OF_FINE_CURVE = 4
"""Number of pointings of a set-up per coefficient, above which a curve of one set-up has `N_CURVE_MODES` basis
functions (eigenfunctions of the Laplacian). With fewer pointings it has `N_PRODUCT_CURVE_MODES`."""
MIN_POINTINGS_PER_COEFFICIENT = 2
"""Smallest number of pointings per coefficient, at the stations and targets of an empirical law (error as a function of
covariates), for which the law is tried. The adjustment absorbs about half of the information of the pointings."""
PER_SETUP_REGRESSOR_KINDS = ("constant", "sign", "curve", "decay", "memory", "lag", "state", "latch")
"""Kinds of regressors (functions of covariates) that are tried for an empirical law of one instrument or one set-up."""
REGION_REGRESSOR_KINDS = ("passage", "lever", "passage for a time", "lever for a time", "near")
"""Kinds of regressors (functions of covariates) that depend on a region of the hall."""
CHANGED_PARTS_BY_REGRESSOR_KIND = dict.fromkeys(("product", *REGION_REGRESSOR_KINDS), ("reading",)) | {
    "room": ("target",)
}
"""Kinds of changed quantities (`Response.changed_part`) that are combined with a kind of regressor (function of
covariates); any other kind of regressor is combined with all. The omitted combinations would be many, and hardly
physical."""
WAVE_COVARIATES_FOR_NON_READING_RESPONSES = (*CLOCK_COVARIATES, *ACCUMULATED_ROTATIONS)
"""Covariates of the waves that are tried for changed quantities that are no readings: times, and accumulated rotations
of the axes."""
MULTI_OBSERVABLE_REGRESSOR_KINDS = (
    "constant",
    "sign",
    "curve",
    "decay",
    "wave",
    "memory",
    "lag",
    "shape",
    "passage",
    "lever",
)
"""Kinds of regressors (functions of covariates) for empirical laws that change several observables together. Other
kinds have too many coefficients."""
RegressorsByKind = Mapping[str, Sequence[Regressor]]
"""Regressors (functions of covariates) by kind, such as `curve` or `wave`."""


def law_batches(space: ResidualSpace, *, tests_ordinary_constants: bool = True) -> list[LawBatch]:
    """Batches of the empirical laws (errors as functions of covariates) that a diagnosis tries in a recording.

    Their prior probabilities add up to the prior probability of a law outside the catalogue. Changes of instrument
    constants that are the same for all readings are included if `tests_ordinary_constants`. They are left out if the
    instrument constants are compared with earlier calibrations. A constant displacement of a target is not included,
    because the coordinates of targets are estimated.
    """
    builder = _LawBatchBuilder(space)
    for place, places, regressors in _places_and_regressors_by_kind(space):
        excluded_kinds = (
            () if tests_ordinary_constants or place not in ("everywhere", "instrument") else ("instrument", "circle")
        )
        builder.add_laws(place, places, regressors, ("target", *excluded_kinds))
    return builder.law_batches()


def _places_and_regressors_by_kind(space: ResidualSpace) -> list[tuple[str, tuple[LawPlace, ...], RegressorsByKind]]:
    """Kinds of places of empirical laws: tuples of name, places, and regressors by kind for these places.

    A place is the stations, targets or instruments where a law acts; a regressor is a function of covariates.
    """
    s = space.sightings
    everywhere = (LawPlace((), (), np.arange(len(s))),)
    stations = tuple(
        LawPlace((name,), (), rows)
        for name, rows in names_and_rows(_names_of_separate_places(s.station_names), s.station)
    )
    targets = tuple(
        LawPlace((), (name,), rows)
        for name, rows in names_and_rows(_names_of_separate_places(s.target_names), s.target)
    )
    is_grouped = len(s.target_names) in TARGET_COUNTS_FOR_GROUP_LAWS
    lengths = ((d.from_, d.to) for d in space.adjustment.recording.gauge.distance)
    sets = target_clusters(s) | neighbour_groups(s) | groups_connected_by_lengths(s, lengths) if is_grouped else set()
    place_groups = tuple(group_places(s, sets))
    median_pointings = float(np.median([len(place.rows) for place in stations] or [0]))
    general_regressors = candidate_regressors(s)
    setup_regressors = (
        general_regressors
        if median_pointings > MIN_POINTINGS_PER_COEFFICIENT_OF_FINE_CURVE * N_CURVE_MODES
        else candidate_regressors(s, N_PRODUCT_CURVE_MODES)
    )
    setup_waves = list(wave_regressors(s, ("station-time",), n_parts=len(s.station_names)))
    return [
        (
            "everywhere",
            everywhere,
            {kind: regressors for kind, regressors in general_regressors.items() if kind != "clock"},
        ),
        (
            "set-up",
            stations,
            {kind: setup_regressors[kind] for kind in PER_SETUP_REGRESSOR_KINDS} | {"wave": setup_waves},
        ),
        (
            "instrument",
            instrument_places(s, space.adjustment.recording.instruments),
            {k: general_regressors[k] for k in PER_SETUP_REGRESSOR_KINDS},
        ),
        (
            "target",
            targets,
            {
                "constant": general_regressors["constant"],
                "clock": general_regressors["clock"],
                "amounts": per_setup_regressors(s, 2),
            },
        ),
        ("group", place_groups, regressors_for_target_groups(s) if place_groups else {}),
    ]


def _names_of_separate_places(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of stations or targets at which separate empirical laws are tried; empty for one name or too many names.

    An empirical law is an error as a function of covariates.
    """
    return names if 1 < len(names) <= MAX_SEPARATE_SETUPS_OR_TARGETS else ()


class _LawBatchBuilder:
    """Builder of batches of empirical laws; laws that differ only in the place where they act are in the same batch.

    An empirical law is an error as a function of covariates.
    """

    def __init__(self, space: ResidualSpace) -> None:
        self._sightings = space.sightings
        self._sigma, self._is_used = space.reading_sigmas, space.is_used_reading
        self._responses: dict[tuple[str, int], list[tuple[Response, Floats]]] = {}
        self._registered: dict[
            tuple[tuple[Response, ...], tuple[Regressor, ...]], list[tuple[tuple[LawPlace, ...], float]]
        ] = {}
        for response, design in response_designs(self._sightings).values():
            weights = np.where(self._is_used[:, :, None], design / self._sigma[:, :, None], 0.0)
            sized = response_with_size_raised_to_noise(response, weights)
            self._responses.setdefault((response.changed_part, len(response.component_names)), []).append(
                (sized, sized.plausible_size * weights)
            )

    def add_laws(
        self,
        place_kind: str,
        places: tuple[LawPlace, ...],
        regressors_by_kind: RegressorsByKind,
        excluded_kinds: tuple[str, ...],
    ) -> None:
        """Addition of the empirical laws at places of one kind, with all admissible responses and regressors.

        A response is a changed quantity, a regressor a function of covariates. `place_kind` is a key of
        `PRIOR_PROBABILITY_BY_PLACE_KIND`. Responses of the kinds `excluded_kinds` are not combined with the regressor
        that is constant.
        """
        kinds = (
            PRIOR_PROBABILITY_BY_RESPONSE_KIND_AT_TARGETS
            if place_kind in ("target", "group")
            else PRIOR_PROBABILITY_BY_RESPONSE_KIND
        )
        for (kind, n_components), kind_responses in self._responses.items():
            n_joint_observables = len(
                kind_responses[0][0].component_units
            )  # number of observables of a joint response; 0 for other responses
            n_responses = sum(
                len(same)
                for (other, n), same in self._responses.items()
                if other == kind and (n == n_components if n_joint_observables else not same[0][0].component_units)
            )
            for name, regressors in regressors_by_kind.items():
                if (
                    kind not in kinds
                    or kind not in CHANGED_PARTS_BY_REGRESSOR_KIND.get(name, (kind,))
                    or (name == "constant" and kind in excluded_kinds)
                ):
                    continue
                if n_joint_observables and (
                    name not in MULTI_OBSERVABLE_REGRESSOR_KINDS or place_kind in ("target", "group")
                ):
                    continue
                admissible_regressors = [
                    d
                    for d in regressors
                    if is_physically_possible(kind, d, self._sightings)
                    and (name != "wave" or _is_wave_tried_for(kind, d))
                ]
                depth = N_OPERATORS_BY_REGRESSOR_KIND[name] + max(n_joint_observables - 1, 0)
                weight = (
                    PRIOR_PROBABILITY_BY_PLACE_KIND[place_kind] * kinds[kind] * ODDS_PER_OPERATOR**depth / n_responses
                )
                self._register_laws_with_prior_weight(
                    tuple(c for c, _ in kind_responses if _may_change_in_region(name, c)),
                    admissible_regressors,
                    places,
                    weight,
                    n_components,
                )

    def _register_laws_with_prior_weight(
        self,
        responses: tuple[Response, ...],
        regressors: Sequence[Regressor],
        places: tuple[LawPlace, ...],
        weight: float,
        n_components: int,
    ) -> None:
        """Registration of empirical laws with the prior `weight` per response, divided among regressors and places.

        A response is a changed quantity with `n_components` components, a regressor a function of covariates. Places
        (stations or targets) with too few pointings for the coefficients of a regressor are left out.
        """
        by_shape: dict[tuple[int, int], list[Regressor]] = {}
        for regressor in regressors if responses else ():
            by_shape.setdefault((regressor.n_columns, len(regressor.coefficient_sigmas)), []).append(regressor)
        fit = {
            k: tuple(p for p in places if len(p.rows) >= MIN_POINTINGS_PER_COEFFICIENT * k[0] * n_components)
            for k in by_shape
        }
        n_laws = sum(len(members) * scales * len(fit[k, scales]) for (k, scales), members in by_shape.items())
        for size, same in by_shape.items():
            if fit[size]:
                self._registered.setdefault((responses, tuple(same)), []).append((fit[size], weight / n_laws))

    def law_batches(self) -> list[LawBatch]:
        """Batches of the registered empirical laws.

        A batch contains all combinations of its responses (changed quantities) and regressors (functions of covariates)
        at all its places (stations, targets or instruments).
        """
        weights = {c: w for kind_responses in self._responses.values() for c, w in kind_responses}
        whole = sum(
            prior * len(group) * len(responses) * sum(len(d.coefficient_sigmas) for d in regressors)
            for (responses, regressors), registrations in self._registered.items()
            for group, prior in registrations
        )
        cells: dict[tuple[int, ...], PointingPartition] = {}
        stacked: dict[tuple[Response, ...], Floats32] = {}
        columns: dict[tuple[tuple[Regressor, ...], bool, tuple[int, ...]], RegressorColumns] = {}
        batches = []
        for (responses, regressors), registrations in self._registered.items():
            places = tuple(place for group, _ in registrations for place in group)
            same = tuple(id(place) for place in places)
            if same not in cells:
                cells[same] = PointingPartition.from_places(places, len(self._sightings))
            if responses not in stacked:
                stacked[responses] = np.stack([weights[c] for c in responses], axis=2, dtype=np.float32)
            key = regressors, responses[0].changed_part == "target", same
            if key not in columns:
                columns[key] = RegressorColumns(
                    regressors, self._sightings, cells[same].pointing_order, acts_on_targets=key[1]
                )
            share = np.concatenate([np.full(len(group), prior / whole) for group, prior in registrations])
            batches.append(
                LawBatch(
                    responses,
                    regressors,
                    places,
                    cells[same],
                    stacked[responses],
                    columns[key],
                    np.log(PRIOR_PROBABILITY_BY_CAUSE_CLASS["law"] * share),
                )
            )
        n_entries = sum(
            shared.n_entries_per_regressor * len(regressors) for (regressors, _, _), shared in columns.items()
        )
        for shared in columns.values():
            shared.is_cached = n_entries <= MAX_CACHED_COLUMN_ENTRIES
        return batches


def _may_change_in_region(regressor_kind: str, response: Response) -> bool:
    """True if an empirical law with a function of the kind `regressor_kind` may change the quantity `response`.

    It is always true for functions without a region of the hall. A range changes in proportion to the length of the
    path in the region (`passage`), and an angle in proportion to this length weighted by its lever (`lever`). An
    empirical law is an error as a function of covariates.
    """
    base_kind = regressor_kind.removesuffix(" for a time")
    return base_kind not in ("passage", "lever") or ("distance" in response.observables) == (base_kind == "passage")


def _is_wave_tried_for(changed_part: str, wave: Regressor) -> bool:
    """True if an empirical law that changes this part of the system (`Response.changed_part`) may follow a wave.

    A wave is a periodic function of a covariate. All waves are tried for readings, and waves of
    `WAVE_COVARIATES_FOR_NON_READING_RESPONSES` for other changed parts.
    """
    return changed_part == "reading" or wave.covariates[0] in WAVE_COVARIATES_FOR_NON_READING_RESPONSES


def response_with_size_raised_to_noise(response: Response, whitened_changes: Floats) -> Response:
    """Copy of a response whose plausible size is at least as large as the noise of the readings.

    The response is the quantity that an empirical law changes. `whitened_changes` (n, 3, c) are the whitened changes of
    the three readings of n pointings per unit of each of its c components. An empirical law is an error as a function
    of covariates.
    """
    change_in_sigmas = response.plausible_size * np.sqrt(np.mean(np.sum(whitened_changes**2, axis=1), axis=1))
    return replace(response, plausible_size=response.plausible_size * size_factor_to_noise_level(change_in_sigmas))
