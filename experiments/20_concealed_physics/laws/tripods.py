"""Fresh laws about tripods, columns and what people and vehicles do beside them."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, shifts


@law("azimuth", may="place")
def one_foot_stands_on_a_rubber_mat(h: Hall, rng: Draw) -> Change:
    """At one set-up a foot stands on a mat, which gives way when the overhang of the head comes over that foot."""
    foot, arm = level(rng), h.aim - h.stand
    over = np.maximum(arm @ foot / np.linalg.norm(arm[:, :2], axis=1) - rng.uniform(-0.3, 0.3), 0.0)
    return leans(h, h.one_station(rng) * over, np.cross(UP, foot))


@law("press_load_kn", may="place time")
def the_slab_dips_beside_the_press(h: Hall, rng: Draw) -> Change:
    """The press pushes the slab down, and stands near by sink and tip with its load, far ones hardly."""
    far = h.stand[:, :2] - rng.uniform(0.3, 0.7, 2) * h.size.room[:2]
    dip = h.load * np.exp(-(far**2).sum(axis=1) / rng.uniform(6.0, 16.0))
    return shifts(h, -dip, UP) + leans(h, dip, level(rng))


@law("distance", may="place azimuth elevation")
def the_helper_at_near_targets_weighs_on_the_boards(h: Hall, rng: Draw) -> Change:
    """On boards the tripod leans towards the helper who holds the ball, when he stands close to it."""
    towards = np.cross(UP, h.aim - h.stand) / h.distance[:, None]
    return leans(h, np.exp(-h.distance / rng.uniform(1.0, 2.5)), towards)


@law("time")
def forklifts_pass_and_the_tripod_recovers(h: Hall, rng: Draw) -> Change:
    """Each passing forklift dents the asphalt under the legs, which comes back within some minutes."""
    passes = (rng.random(h.n) < 0.03) * rng.uniform(0.5, 1.5, h.n)
    return leans(h, h.fading(passes, rng.uniform(150.0, 400.0)), level(rng))


@law("time")
def the_lift_column_sinks_and_is_pumped_up(h: Hall, rng: Draw) -> Change:
    """The hydraulic column of one stand leaks and sinks evenly, until a switch pumps it up again."""
    period = rng.uniform(250.0, 600.0)
    return shifts(h, -h.one_station(rng) * np.mod(h.since_setup, period) / period, UP)


@law("temperature", may="time")
def one_leg_of_the_tripod_is_of_another_metal(h: Hall, rng: Draw) -> Change:
    """One leg of steel and two of carbon: the tripod leans as that leg takes on the warmth of the hall."""
    return leans(h, h.lagging(h.warmth, rng.uniform(300.0, 1200.0)), level(rng))


@law("time", may="place")
def gusts_at_the_gate_twist_the_stands(h: Hall, rng: Draw) -> Change:
    """Wind through the open gate wanders, and twists the stands close to the gate more than those farther in."""
    near = np.exp(-h.stand[:, 0] / (rng.uniform(0.2, 0.5) * h.size.room[0]))
    return leans(h, near * h.walk(rng), UP)
