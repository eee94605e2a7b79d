"""Fresh laws about people, shifts, bars and what is written down."""

from ..law import Change, Draw, Hall, gauge, law, moves, np, scatters


@law("temperature")
def a_bar_of_aluminium_among_invar(h: Hall, rng: Draw) -> Change:
    """One of the two known lengths is of aluminium and grows from its middle with the hall's warmth."""
    first, last = h.bars[int(rng.integers(2))]
    way = h.pointings.points[last] - h.pointings.points[first]
    target = h.pointings.target
    end = (target == last).astype(np.float64) - (target == first)
    return moves(h, end * h.warmth, way)


@law("time")
def the_second_round_is_done_by_another_hand(h: Hall, rng: Draw) -> Change:
    """Another person sets the reflectors on the wall in the second rounds and does not press them home."""
    again = (h.pointings.repeat == 2).astype(np.float64)
    if not again.any():
        raise LookupError("one round only")
    return moves(h, again * h.group("wall"), h.normal)


@law()
def now_and_then_somebody_walks_through(h: Hall, rng: Draw) -> Change:
    """People pass through a sight at odd moments, and the angles averaged then scatter several times as much."""
    hit = rng.random(h.n) < rng.uniform(0.08, 0.16)
    return scatters(h, "azimuth elevation", 0.002 + hit * rng.gamma(2.0, 0.5, h.n))


@law("approach", may="face azimuth")
def the_azimuth_drive_rings_after_a_long_way(h: Hall, rng: Draw) -> Change:
    """After a long slew the azimuth drive still rings when the reading begins, and it scatters."""
    return scatters(h, "azimuth", (np.abs(h.swing) / np.pi) ** rng.uniform(1.5, 3.0))


@law("time")
def the_gallery_trembles_at_change_of_shift(h: Hall, rng: Draw) -> Change:
    """While people walk on the gallery its targets tremble, and all that is read of them scatters."""
    return scatters(h, "distance azimuth elevation", h.group("gallery") * h.windows(rng))


@law()
def corrections_of_two_bars_are_exchanged(h: Hall, rng: Draw) -> Change:
    """Somebody entered each bar's correction at the other one: one length is too long and the other too short."""
    return gauge(h, rng.choice([-1.0, 1.0]) * np.array([1.0, -1.0]))
