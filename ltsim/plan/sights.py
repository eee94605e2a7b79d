"""From how many stations every reflector can be seen, answered before a search."""

from __future__ import annotations

import numpy as np

from ltsim.errors import SetupError
from ltsim.plan.search import Searcher
from ltsim.plan.site import Site
from ltsim.plan.spec import PlanFile
from ltsim.randomness import stream

FEWEST = 3
"""Targets in sight that a station needs."""


def most_sights(site: Site, step: float, heights: int) -> tuple[int, str]:
    """The largest number of stations that some layout has in sight of every reflector; the reflector that limits it.

    Stations are put one after the other where they bring most reflectors nearer to the number: a lower bound, which is
    the truth where some place on the floor sees everything.
    """
    position, _ = site.grid(step, 1, heights)
    seen, names = site.seen(position), site.survey.target_names
    fixed = site.survey.position[list(site.fixed)]
    begin = site.seen(fixed).sum(axis=0) if len(fixed) else np.zeros(len(names), dtype=np.int64)
    limiting = names[int(np.argmin(seen.mean(axis=0)))] if len(position) else names[0]
    for wanted in range(site.least, 0, -1):
        count, placed = begin.copy(), [*fixed]
        for _ in range(len(site.survey.position) - len(fixed)):
            useful = np.minimum(count + seen, wanted).sum(axis=1) * (seen.sum(axis=1) >= FEWEST)
            for other in placed:
                useful[np.linalg.norm(position[:, :2] - other[:2], axis=1) < site.spacing] = -1
            if not len(useful) or useful.max() <= 0:
                break
            best = int(np.argmax(useful))
            placed.append(position[best])
            count += seen[best]
        if len(placed) == len(site.survey.position) and count.min() >= wanted:
            return wanted, limiting
    return 0, limiting


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
    if "seen_from" not in file.stations.model_fields_set and found:
        return file.model_copy(update={"stations": file.stations.model_copy(update={"seen_from": found})})
    searcher = Searcher(site, step=settings.grid_mm * 1e-3, yaws=1, heights=settings.heights)
    try:
        searcher.random_layout(stream(settings.seed, "plan", "sights"))
    except SetupError as problem:
        if not found:
            raise
        raise SetupError(
            f"stations.seen_from asks that every reflector is seen from {site.least} of {count} stations; {found} is "
            f"the best that was found, and {limiting} is seen from the fewest places: set stations.seen_from = "
            f"{found}, move {limiting}, or widen the floor"
        ) from problem
    return file
