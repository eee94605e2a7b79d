"""Laws about reflectors, nests and the bars of known length."""

from ..law import UP, Change, Draw, Hall, gauge, law, moves, np, reads


@law("time")
def a_reflector_warms_in_the_hand(h: Hall, rng: Draw) -> Change:
    """The reflector comes cold out of its case at every set-up; in the hand its ball warms and grows."""
    return moves(h, 5.0 * (1.0 - np.exp(-h.since_setup / rng.uniform(150.0, 500.0))), h.normal)


@law("time", may="approach")
def nests_wear_in_with_every_seating(h: Hall, rng: Draw) -> Change:
    """New nests give a little at each seating of the reflector, which sits the deeper the more often it was there."""
    p = h.pointings
    seats: dict[int, list[tuple[int, int]]] = {}
    before = np.empty(h.n)
    for i, (target, visit) in enumerate(zip(p.target, zip(p.station, p.repeat, strict=True), strict=True)):
        known = seats.setdefault(int(target), [])
        if visit not in known:
            known.append(visit)
        before[i] = len(known) - 1
    return moves(h, -4.0 * before ** rng.uniform(0.5, 1.0), h.normal)


@law("distance")
def a_larger_reflector_for_far_targets(h: Hall, rng: Draw) -> Change:
    """From some distance on the operator takes a larger reflector, whose depth is a little off its data sheet."""
    return reads(h, "distance", 10.0 * (h.distance > np.quantile(h.distance, rng.uniform(0.4, 0.7))))


@law("temperature", may="place")
def magnets_of_the_wall_nests_weaken(h: Hall, rng: Draw) -> Change:
    """Magnets hold less when it is warm, so in nests that look sideways the reflector hangs a little lower."""
    return moves(h, -10.0 * h.group("wall") * h.warmth, UP)


@law("incidence", may="place")
def turning_the_reflector_pushes_it_off_its_points(h: Hall, rng: Draw) -> Change:
    """The collar of a reflector that is turned far aside touches the nest's rim and lifts the ball."""
    free = rng.uniform(0.4, 0.7)
    return moves(h, 20.0 * np.maximum(h.incidence - free, 0.0), h.normal)


@law()
def an_upright_bar_is_shorter_than_a_lying_one(h: Hall, rng: Draw) -> Change:
    """The bars were certified lying; the one that stands upright is shortened by its upper nest and its own weight."""
    return gauge(h, np.array([0.0, 10.0]))


@law()
def labels_of_the_two_bars_are_exchanged(h: Hall, rng: Draw) -> Change:
    """Two bars of nearly the same length wear each other's labels: one is too long by what the other lacks."""
    return gauge(h, 10.0 * np.array([1.0, -1.0]) * rng.choice([-1.0, 1.0]))
