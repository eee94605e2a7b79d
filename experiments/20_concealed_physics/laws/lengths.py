"""Used laws about what the network is told besides its readings: the lengths of the certificate."""

from ..law import Change, Draw, Hall, gauge, law


@law(may="temperature distance")
def bars_measured_in_a_cold_laboratory(h: Hall, rng: Draw) -> Change:
    """The certificate was made in a cold laboratory and not brought to 20 degrees: every length is short alike."""
    return gauge(h, -h.lengths)


@law(may="place")
def one_bar_has_been_dropped(h: Hall, rng: Draw) -> Change:
    """One of the bars fell and is bent; its certificate has not heard of it."""
    bent = rng.integers(len(h.bars))
    return gauge(h, [float(b == bent) for b in range(len(h.bars))])
