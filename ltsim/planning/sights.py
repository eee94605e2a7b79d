"""From how many stations every reflector can be seen, answered before a search."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.errors import SetupError
from ltsim.planning.search import Searcher
from ltsim.planning.site import Site
from ltsim.planning.spec import PlanFile
from ltsim.randomness import stream

FEWEST = 3
"""Targets in sight that a station needs."""
SWEEPS = 6
"""Rounds of exchanges at most."""


def most_sights(site: Site, step: float, heights: int) -> tuple[int, str]:
    """The largest number of stations that some layout has in sight of every reflector; the reflector that limits it.

    Stations are put one after the other where they bring most reflectors nearer to the number, then exchanged one by
    one until none brings more: a lower bound, which is the truth where some place on the floor sees everything.
    """
    position, _ = site.grid(step, 1, heights)
    names = site.survey.target_names
    if not len(position):
        return 0, names[0]
    seen = site.seen(position)
    limiting = names[int(np.argmin(seen.mean(axis=0)))]
    for wanted in range(site.least, 0, -1):
        if _reached(site, position, seen, wanted):
            return wanted, limiting
    return 0, limiting


def _reached(site: Site, position: Floats, seen: Bools, wanted: int) -> bool:
    """Whether stations among the set-ups (N, 3) that see (N, T) are found so that each target is seen from `wanted`."""
    fixed = site.survey.position[list(site.fixed)]
    begin = site.seen(fixed).sum(axis=0) if len(fixed) else np.zeros(seen.shape[1], dtype=np.int64)
    enough = seen.sum(axis=1) >= FEWEST

    def best(others: list[int]) -> int:
        """The set-up that brings most beside others; -1 where none may stand."""
        useful = np.minimum(begin + seen[others].sum(axis=0) + seen, wanted).sum(axis=1) * enough
        for place in (*fixed, *position[others]):
            useful[np.linalg.norm(position[:, :2] - place[:2], axis=1) < site.spacing] = -1
        return int(np.argmax(useful)) if useful.max() > 0 else -1

    def missing(chosen: list[int]) -> int:
        return int(np.maximum(wanted - begin - seen[chosen].sum(axis=0), 0).sum())

    chosen: list[int] = []
    for _ in range(len(site.survey.position) - len(fixed)):
        if (one := best(chosen)) < 0:
            return False
        chosen.append(one)
    for _ in range(SWEEPS):
        before = missing(chosen)
        for k in range(len(chosen)):
            others = chosen[:k] + chosen[k + 1 :]
            tried = [*chosen[:k], best(others), *chosen[k + 1 :]]
            chosen = tried if missing(tried) < missing(chosen) else chosen
        if missing(chosen) in (0, before):
            break
    return missing(chosen) == 0


def with_reachable_sights(file: PlanFile, site: Site) -> PlanFile:
    """The file with a `stations.seen_from` that some layout keeps; one that was asked for is not lowered.

    Raises
    ------
    SetupError
        When more is asked for than any layout that was found keeps: it says what can be had.
    """
    settings, count = file.search, len(site.survey.position)
    found, limiting = most_sights(site, settings.grid_mm * 1e-3, settings.heights)
    if found >= site.least:
        return file

    def refused(least: int) -> SetupError | None:
        """Why the search finds no layout to begin from; None where it does."""
        where = site.replace(least=least)
        searcher = Searcher(where, step=settings.grid_mm * 1e-3, yaws=1, heights=settings.heights)
        try:
            searcher.random_layout(stream(settings.seed, "plan", "sights"))
        except SetupError as problem:
            return problem
        return None

    if "seen_from" not in file.stations.model_fields_set and found:
        while found > 1 and refused(found):
            found -= 1
        return file.model_copy(update={"stations": file.stations.model_copy(update={"seen_from": found})})
    problem = refused(site.least)
    if problem is None:
        return file
    if not found:
        raise problem
    raise SetupError(
        f"stations.seen_from asks that every reflector is seen from {site.least} of {count} stations; {found} is "
        f"the best that was found, and {limiting} is seen from the fewest places: set stations.seen_from = "
        f"{found}, move {limiting}, or widen the floor"
    )
