"""One target under names that differ by set-up: `P 01` and `p1`, `S1_P01` and `S2_P01`."""

from __future__ import annotations

import re
from collections.abc import Sequence

MOST_SHOWN = 4


def common_names(sightings: Sequence[tuple[str, str]]) -> tuple[list[str], list[str]]:
    """Target of each sighting (station, target) by one name for all set-ups, and what was changed.

    A set-up's own name before or after those of all its targets is taken away where set-ups then share targets that
    they did not share before. Names that differ in case, blanks or leading zeros are one where no set-up has both.
    """
    targets, notes = [target for _, target in sightings], []
    bare = [_without(station, target) for station, target in sightings]
    if all(bare) and len({station for station, _ in sightings}) > 1:
        stations = [station for station, _ in sightings]
        if not _shared(stations, targets) and _shared(stations, bare):
            notes.append(f"the set-up's name is taken from its targets' names: '{targets[0]}' is '{bare[0]}'")
            targets = bare
    places: dict[str, set[str]] = {}
    for (station, _), target in zip(sightings, targets, strict=True):
        places.setdefault(target, set()).add(station)
    alike: dict[str, list[str]] = {}
    for target in places:
        alike.setdefault(_folded(target), []).append(target)
    one = {
        name: spellings[0]
        for spellings in alike.values()
        if len(spellings) > 1
        and sum(len(places[s]) for s in spellings) == len(set().union(*(places[s] for s in spellings)))
        for name in spellings[1:]
    }
    if one:
        some = ", ".join(f"'{name}' and '{first}'" for name, first in list(one.items())[:MOST_SHOWN])
        more = f" and {len(one) - MOST_SHOWN} more" if len(one) > MOST_SHOWN else ""
        notes.append(f"names that differ in case, blanks or leading zeros are taken as one target: {some}{more}")
    return [one.get(target, target) for target in targets], notes


def _without(station: str, target: str) -> str:
    """The name of a target without that of its set-up; empty where it does not hold it."""
    found = re.fullmatch(rf"{re.escape(station)}[\s._:/-]+(.+)|(.+?)[\s._:/-]+{re.escape(station)}", target)
    return (found[1] or found[2]) if found else ""


def _shared(stations: Sequence[str], targets: Sequence[str]) -> bool:
    """Whether any target was seen from two set-ups."""
    return len({*zip(stations, targets, strict=True)}) > len({*targets})


def _folded(name: str) -> str:
    bare = re.sub(r"(?<=[^\W\d_])[\s_-]+(?=\d)", "", name.casefold())
    return re.sub(r"(?<!\d)0+(?=\d)", "", re.sub(r"[\s_-]+", "_", bare))
