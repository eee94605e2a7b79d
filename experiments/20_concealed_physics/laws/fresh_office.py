"""Fresh laws about certificates, programs and habits."""

from ..law import Change, Draw, Hall, gauge, law, level, moves, np, varies


@law()
def the_certificate_was_made_with_other_balls(h: Hall, rng: Draw) -> Change:
    """The known lengths were calibrated with balls whose vertices lie elsewhere, so all are off by the same amount."""
    return gauge(h, np.ones(len(h.bars)))


@law(may="place elevation azimuth", signals=3)
def an_old_compensation_file_was_loaded_at_one_station(h: Hall, rng: Draw) -> Change:
    """For one station the program took the compensation of another day, with other collimation, tilt and index."""
    here, size = h.random_station(rng), rng.standard_normal(3)
    names = ("beam-tilt", "transit-tilt", "vertical-index")
    first, second, third = (varies(h, name, v * here) for name, v in zip(names, size.tolist(), strict=True))
    return first + second + third


@law("temperature|time", may="distance place")
def the_weather_of_the_set_up_before_is_kept(h: Hall, rng: Draw) -> Change:
    """The operator enters the temperature after the work: each set-up is corrected by that of the one before."""
    station = h.pointings.station
    mean = np.array([h.warmth[station == s].mean() for s in range(len(h.stations))])
    return varies(h, "range-scale", np.diff(mean, prepend=mean[0])[station])


@law("face", signals=2)
def the_compensation_is_applied_to_one_face_only(h: Hall, rng: Draw) -> Change:
    """An import filter applies collimation and tilt of the axes to readings of the front face and forgets the back."""
    if not h.back.any():
        raise LookupError("one face only")
    share = rng.standard_normal(2)
    return varies(h, "beam-tilt", share[0] * h.back) + varies(h, "transit-tilt", share[1] * h.back)


@law("time", may="place")
def the_late_shift_presses_the_ball_less(h: Hall, rng: Draw) -> Change:
    """From the change of shift on another hand sets the ball on the wall nests, less firmly, and it stands out."""
    return moves(h, h.group("wall") * (h.time > rng.uniform(0.3, 0.7) * h.time[-1]), h.normal)


@law(may="place time")
def the_operator_leans_on_the_bench_at_one_station(h: Hall, rng: Draw) -> Change:
    """At one station the operator has to lean over the table to reach the nests, and pushes it aside as he does."""
    return moves(h, h.random_station(rng) * h.group("table"), level(rng))
