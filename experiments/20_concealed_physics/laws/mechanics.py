"""Used laws about mechanics: bearings, stands, floors, and what stands on them."""

from ..law import OUT, UP, Change, Draw, Hall, law, leans, level, moves, np, reads, scatters, shifts, varies


@law("press_load_kn", "place")
def floor_dips_beside_the_press(h: Hall, rng: Draw) -> Change:
    """The press presses its pit into the ground, and the floor's nests sink the more the nearer they are."""
    pit = rng.uniform(0.2, 0.8, 2) * np.array(h.size.room[:2])
    far = np.sqrt(((h.aim[:, :2] - pit) ** 2).sum(axis=1))
    return moves(h, -h.group("floor") * h.load * np.exp(-far / 2.5), UP)


@law("press_load_kn", may="time place")
def wall_bracket_sticks_and_slips(h: Hall, rng: Draw) -> Change:
    """The wall is pushed out by a hard stroke, sticks in its bracket and slips back only when the press is idle."""
    return moves(h, h.group("wall") * h.latched(h.load, 0.15, 0.8), OUT)


@law("approach", may="azimuth place")
def loose_clamp_follows_the_head(h: Hall, rng: Draw) -> Change:
    """The clamp of one stand is loose, and the start of every turn of the head twists the stand the other way."""
    return leans(h, -h.one_station(rng) * np.tanh(h.swing / rng.uniform(1.0, 2.0)), UP)


@law("azimuth", may="face")
def standing_axis_wobbles_thrice(h: Hall, rng: Draw) -> Change:
    """The bearing of the standing axis rests on three high spots and tips the head three times a turn."""
    phase = 3.0 * h.circle + rng.uniform(-np.pi, np.pi)
    return leans(h, np.ones(h.n), np.column_stack([np.cos(phase), np.sin(phase), np.zeros(h.n)]))


@law("approach", may="azimuth")
def ball_cage_runs_at_half_speed(h: Hall, rng: Draw) -> Change:
    """One ball of the bearing is thicker; its cage turns a little less than half as far as the head has turned."""
    return varies(h, "transit-tilt", np.cos(rng.uniform(0.42, 0.48) * h.wound + rng.uniform(-np.pi, np.pi)))


@law("approach", may="azimuth")
def cable_pulls_when_it_is_wound_up(h: Hall, rng: Draw) -> Change:
    """The cable is slack for one turn and a half, then drags the stand around with it."""
    return leans(h, np.sign(h.wound) * np.maximum(np.abs(h.wound) - rng.uniform(1.0, 3.0), 0.0), UP)


@law("time|approach")
def brake_creeps_while_it_waits(h: Hall, rng: Draw) -> Change:
    """The brake of the elevation axis lets the tube sink slowly between one pointing and the next."""
    return reads(h, "elevation", 1.0 - np.exp(-h.gap / rng.uniform(15.0, 60.0)))


@law("time", may="place height")
def air_cushion_table_leaks(h: Hall, rng: Draw) -> Change:
    """The table floats on air and sinks until its pump lifts it again, at regular intervals."""
    cycle = rng.uniform(1200.0, 3000.0)
    return moves(h, -h.group("table") * np.mod(h.time + rng.uniform(0.0, cycle), cycle) / cycle, UP)


@law("time", may="place")
def lorries_shake_the_stand_at_the_gate(h: Hall, rng: Draw) -> Change:
    """Now and then a lorry drives past; each time the stand there is tipped a little and rights itself in minutes."""
    return leans(h, h.one_station(rng) * h.fading(rng.random(h.n) < 0.08, rng.uniform(90.0, 400.0)), level(rng))


@law("elevation")
def fork_arm_gives_way(h: Hall, rng: Draw) -> Change:
    """Steep beams bring the weight of the tube over one arm of the fork, which yields sideways with the square."""
    return varies(h, "beam-offset-lateral", np.sin(2.0 * h.elevation) * np.abs(np.sin(h.elevation)))


@law("time", may="place height")
def travelling_crane_bends_the_gallery(h: Hall, rng: Draw) -> Change:
    """The crane goes to and fro below the gallery all day, and the bay over it hangs down."""
    crane = 0.5 * h.size.room[0] * (1.0 + np.sin(2.0 * np.pi * h.time / rng.uniform(1500.0, 4000.0)))
    return moves(h, -h.group("gallery") * np.exp(-(((h.aim[:, 0] - crane) / 2.0) ** 2)), UP)


@law("press_load_kn", may="time place")
def ram_recoil_shoves_one_stand(h: Hall, rng: Draw) -> Change:
    """The recoil of the ram shoves the stand on the press's own foundation along the hall in step with its force."""
    return shifts(h, h.one_station(rng) * h.load, OUT)


@law("approach")
def whip_of_the_tube(h: Hall, rng: Draw) -> Change:
    """After a long turn the head has not come to rest when it measures, and its angles scatter."""
    return scatters(h, "azimuth elevation", h.swing**2)
