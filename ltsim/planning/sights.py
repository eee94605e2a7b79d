"""From how many stations every reflector can be seen, answered before a search."""

from __future__ import annotations

import numpy as np

from ltsim.errors import SetupError
from ltsim.planning.search import MOST_NAMED, Searcher
from ltsim.planning.site import Site, grid_step
from ltsim.planning.spec import PlanFile
from ltsim.randomness import stream


def most_sights(site: Site, step: float, heights: int) -> tuple[int, str]:
    """The largest number of stations that some layout has in sight of every reflector; the reflector that limits it.

    A lower bound by the greedy placement, which is the truth where some place on the floor sees everything.
    """
    placement, names = site.placement(step, heights), site.survey.target_names
    if not len(placement.position):
        return 0, names[0]
    limiting = names[int(np.argmin(placement.seen.mean(axis=0)))]
    count = len(site.survey.position) - len(site.fixed)
    for wanted in range(site.least, 0, -1):
        if not placement.missing(placement.stations(count, wanted), wanted):
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
    step = grid_step(site.areas, settings.grid_mm)
    found, limiting = most_sights(site, step, settings.heights)
    if found >= site.least:
        return file

    def refused(least: int) -> SetupError | None:
        """Why the search finds no layout to begin from; None where it does."""
        searcher = Searcher(site.replace(least=least), step=step, yaws=1, heights=settings.heights)
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


def check_in_sight(site: Site, file: PlanFile) -> None:
    """Raise SetupError, with their names, where points are in sight from no place on the floor, or from too few."""
    placement = site.placement(grid_step(site.areas, file.search.grid_mm), file.search.heights)
    unseen = np.flatnonzero(placement.seen.sum(axis=0) == 0)
    hidden = [site.survey.target_names[t] for t in unseen]
    if not len(placement.position):
        raise SetupError("no place on the floor sees three points; widen the floor, or move obstacles")
    if hidden:
        more = f" and {len(hidden) - MOST_NAMED} more" if len(hidden) > MOST_NAMED else ""
        verb = "is" if len(hidden) == 1 else "are"
        raise SetupError(
            f"{', '.join(hidden[:MOST_NAMED])}{more} {verb} in sight from none of {len(placement.position)} places on "
            "the floor; widen it, move them, or look whether they lie inside an obstacle"
        )
