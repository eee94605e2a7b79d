"""Fresh laws about habits of the crew, and about what the software does with the readings."""

from ..law import Change, Draw, Hall, law, moves, np, reads, varies


@law("temperature|time", may="temperature time")
def the_air_is_typed_in_now_and_then(h: Hall, rng: Draw) -> Change:
    """The air is typed in by hand every so often, and the wavelength is stale by what has changed since."""
    turn = np.floor(h.time / rng.uniform(2400.0, 4800.0))
    return varies(h, "range-scale", h.warmth - h.warmth[np.searchsorted(turn, turn)])


@law("approach", may="distance time")
def the_filter_still_holds_the_last_distance(h: Hall, rng: Draw) -> Change:
    """The distance is smoothed and the filter not emptied between targets; of the last one a bit is left."""
    return reads(h, "distance", -h.change(h.distance) * np.exp(-h.gap / rng.uniform(6.0, 15.0)))


@law("time", "height", may="place")
def tired_arms_press_high_balls_home_less(h: Hall, rng: Draw) -> Change:
    """As the day goes on the helper presses balls less firmly into their nests, the more so overhead."""
    return moves(h, np.abs(h.aim[:, 2]) ** rng.uniform(1.0, 2.0) * h.time / 3600.0, h.normal)


@law("elevation")
def the_table_of_corrections_has_few_rows(h: Hall, rng: Draw) -> Change:
    """The correction of the elevation is looked up in a table of few rows, and is right in the middle of each."""
    rows = h.elevation / rng.uniform(0.2, 0.4) + rng.random()
    return reads(h, "elevation", rows - np.floor(rows) - 0.5)


@law("time", may="place")
def an_old_parameter_file_is_loaded_from_one_visit_on(h: Hall, rng: Draw) -> Change:
    """The computer was started again between two set-ups, and from then on uses last year's offsets."""
    later = 1.0 * (h.pointings.station >= rng.integers(1, len(h.stations) - 1))
    return varies(h, "beam-offset-lateral", later) + varies(h, "transit-offset", rng.uniform(-1.0, 1.0) * later)


@law("time")
def two_helpers_relieve_each_other(h: Hall, rng: Draw) -> Change:
    """Two helpers take turns by the clock, and one of them does not press the balls home in their nests."""
    turn = np.floor(h.time / rng.uniform(900.0, 2100.0) + rng.random())
    return moves(h, np.mod(turn, 2.0), h.normal)
