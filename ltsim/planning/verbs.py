"""Public functions of planning: the search, alternatives to a station, the next measurement."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsim.adjustment.remedies.next_measurement import ProgressCallback, no_progress, rank_next_measurements as ranked
from ltsim.core.arguments import MOVE_FORM, check_bounds, check_mapping
from ltsim.core.arrays import Floats
from ltsim.core.errors import SetupError, option, unknown_name
from ltsim.core.units import DEGREE, MICROMETRE, MILLIMETRE
from ltsim.physics.effects.signature import Signature
from ltsim.planning.making import Follower, make_plan
from ltsim.planning.planner import PlannedNetwork, judge
from ltsim.planning.proposals import NextMeasurement
from ltsim.planning.result import Plan, opened
from ltsim.planning.site import SearchSpace, words_of
from ltsim.planning.spec import PlanFile
from ltsim.planning.starts import PlanningProblem
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import Tolerances, judged, losses_of, verdict
from ltsim.planning.workshop import as_it_stands
from ltsim.recordings.exchange import RecordingSource, recording_of
from ltsim.recordings.result_file import SourceEntry
from ltsim.simulation.scenario import Scenario

MIN_ALTERNATIVE_DISTANCE = 2.0
"""Distance [m] of proposed places from an impossible place and from each other."""
MAX_ALTERNATIVES = 4
"""Largest number of proposed places."""


def plan(
    source: str | Path = "paper-workshop",
    *,
    starts: int | None = None,
    seed: int | None = None,
    jobs: int = 1,
    progress: ProgressCallback = no_progress,
    follower: Follower | None = None,
    move: Mapping[str, Sequence[float]] | None = None,
) -> Plan:
    """Layout of stations and reflectors, with reasons and the curve of cost against quality.

    Parameters
    ----------
    source : str or Path
        A plan file, a scenario file, the name of a built-in one, or the folder of a plan.
    starts : int, optional
        Independent searches; default as the file says.
    seed : int, optional
        Root of the search; default as the file says.
    jobs : int
        Processes; the plan does not depend on it.
    progress : callable
        Told what is done and the share of it.
    follower : Follower, optional
        In place of `progress`: also hears how long it may take, and is given the best layout so far.
    move : mapping, optional
        Nothing is searched: the layout as it stands, with these stations at other places: x, y, z in mm and yaw in
        degrees; yaw, or z and yaw, may be left out.

    Raises
    ------
    SetupError
        In one sentence, for a plan that cannot be made.

    Examples
    --------
    >>> import ltsim as lt
    >>> made = lt.plan("small-plan.toml")
    >>> made.to_dataframe("stations").shape
    (3, 9)
    """
    check_bounds(starts=starts, seed=seed, jobs=jobs, required="jobs")
    check_mapping("move", move)
    file, scenario = opened(source)
    if move is not None:
        return Plan.of(_moved(file, scenario, move))
    changes = {key: value for key, value in (("seed", seed), ("starts", starts)) if value is not None}
    file = file.model_copy(update={"search": file.search.model_copy(update=changes)})
    return Plan.of(make_plan(file, scenario, jobs=jobs, follower=follower or Follower(progress)))


def next_measurement(
    recording: RecordingSource,
    *,
    between: Sequence[str] = (),
    with_effects: str | Signature | Sequence[str | Signature] = (),
    minutes_per_move: float = 20.0,
    progress: ProgressCallback = no_progress,
) -> NextMeasurement:
    """Ranking of additional measurements after a recording.

    Parameters
    ----------
    recording : Recording, str or Path
    between : sequence of str
        Names of two or more effects: rank by how many are told from the first, of these what asks least of a person
        and is done first, then by the evidence between them; none: rank what can be pointed at from here or from a
        further station by what it tells about the instrument's parameters.
    with_effects : str, Effect or sequence of them
        What has been found already beside the question; of a name, where it fits the residuals best.
    minutes_per_move : float
        What it costs to move the tripod.
    progress : callable
        Told what is done and the share of it.

    Raises
    ------
    ModelError
        When an effect does not exist, is a noise effect, or cannot be fitted to this recording.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> proposals = lt.next_measurement(recording)
    >>> proposals.proposals[0].sharper < 1
    True
    """
    measured = recording_of(recording)
    made = ranked(
        measured, explanations=between, with_effects=with_effects, minutes_per_move=minutes_per_move, progress=progress
    )
    return NextMeasurement.of(made, SourceEntry.of(measured))


@dataclass(frozen=True)
class Alternative:
    """Alternative to a station: another position with all others unchanged, or the layout without it."""

    words: str
    """Text of the position of the station."""
    survey: Survey
    verdict: str
    """Sentence on the layout."""
    worth: float
    """Largest ratio of error to tolerance, after relevant losses too; without tolerances the largest sigma [m]."""
    good: bool
    """True if no rule is broken and the goal (if there are tolerances) is reached."""
    move: str = ""
    """Value of `--move` that evaluates it; empty for the layout without the station."""


def without_station(source: str | Path, station: str) -> tuple[Alternative, ...]:
    """Alternatives to a station: the layout without it, then with it at the best other positions.

    Parameters
    ----------
    source : str or Path
        The folder of a plan, a plan file or a scenario; its stations are the layout.
    station : str
        The one that cannot stand where it is.

    Raises
    ------
    SetupError
        When there is no such station, or no place for it.
    """
    named, scenario = opened(source)
    file, site = as_it_stands(named, scenario)
    problem, survey = PlanningProblem(file, scenario), site.survey
    slot = _index(survey, station)
    others = [s for s in range(len(survey.position)) if s != slot]
    work = problem.searcher(site.replace(survey=survey, fixed=tuple(others), min_sights=0))
    table = work.table(slot)
    values = work.replacements(work.layout(survey.position, survey.yaw), slot, table)
    values[_gap(table.position, survey.position[slot]) < MIN_ALTERNATIVE_DISTANCE] = np.inf
    # Sights of points with a tolerance that would be missing decide first.
    demanded = Tolerances.of(file).tolerance or survey.target_names
    asked = np.array([name in demanded for name in survey.target_names])
    lacking = np.maximum(site.min_sights - survey.visible[others].sum(axis=0) - table.visible, 0)[:, asked].sum(axis=1)
    alternatives: list[Alternative] = []
    for best in np.lexsort((values, lacking)).tolist():
        near = [
            _gap(table.position[[best]], option_.survey.position[slot])[0] < MIN_ALTERNATIVE_DISTANCE
            for option_ in alternatives
        ]
        if len(alternatives) == MAX_ALTERNATIVES or not np.isfinite(values[best]) or any(near):
            continue
        position, yaw = survey.position.copy(), survey.yaw.copy()
        position[slot], yaw[slot] = table.position[best], table.yaw[best]
        there = survey.replace(position=position, yaw=yaw, visible=site.visible(position))
        words = f"{_at(station, position[slot])}, turned by {yaw[slot] / DEGREE:.0f} deg"
        x, y, z = position[slot] / MILLIMETRE
        move = f"{station}={x:.1f},{y:.1f},{z:.1f},{yaw[slot] / DEGREE:g}"
        alternatives.append(_alternative(problem, site, there, words, move))
    alone = _alternative(problem, site, survey.without(slot), f"without {station}")
    return (alone, *sorted(alternatives, key=lambda option_: (not option_.good, option_.worth)))


def _moved(named: PlanFile, scenario: Scenario, to: Mapping[str, Sequence[float]]) -> PlannedNetwork:
    """Planned network with stations at other positions: x, y, z [mm] and yaw [deg] of each.

    The last ones may be missing.

    Raises SetupError for a position where no tripod may stand.
    """
    file, site = as_it_stands(named, scenario)
    survey = site.survey
    position, yaw = survey.position.copy(), survey.yaw.copy()
    for name, given in to.items():
        slot, place = _index(survey, name), _place_of(name, given)
        position[slot, : len(place[:3])] = place[:3] * MILLIMETRE
        yaw[slot] = place[3] * DEGREE if len(place) == 4 else yaw[slot]
    survey = survey.replace(position=position, yaw=yaw)
    wrong = [rule for rule in site.broken_places(survey) if {*rule.stations} & {*to}]
    if wrong:
        raise SetupError(f"{option('move')}: {words_of(wrong)}")
    return judge(file, scenario, survey.replace(visible=site.visible(position)))


def _place_of(name: str, given: object) -> Floats:
    """Numbers (2 to 4) of a new position; raises SetupError."""
    words = np.ravel(np.asarray(given, dtype=object)).tolist()
    try:
        place = np.array(words, dtype=np.float64)
    except (TypeError, ValueError):
        place = np.zeros(0)
    if not 2 <= len(place) <= 4 or not np.all(np.isfinite(place)):
        raise SetupError(f"{option('move')} {name}={','.join(map(str, words))}: expected {MOVE_FORM}")
    return place


def _at(station: str, place: Floats) -> str:
    x, y, z = place
    return f"{station} at ({x:.2f}, {y:.2f}, {z:.2f}) m"


def _gap(places: Floats, place: Floats) -> Floats:
    return np.linalg.norm(places[:, :2] - place[:2], axis=1)


def _index(survey: Survey, name: str) -> int:
    if name not in survey.station_names:
        raise SetupError(str(unknown_name("station", name, survey.station_names)))
    return survey.station_names.index(name)


def _alternative(
    problem: PlanningProblem, site: SearchSpace, survey: Survey, words: str, move: str = ""
) -> Alternative:
    """Alternative layout, evaluated by the rules and tolerances, or by its worst point if there are none."""
    demands, built, broken = Tolerances.of(problem.file), problem.built, site.broken_rules(survey)
    if demands:
        check = judged(survey, demands, built)
        losses = losses_of(survey, demands, built)
        ratio = max([check.ratio, *([loss.ratio for loss in losses] if demands.robust != "no" else [])])
        judgement = verdict(demands, check, losses, broken)
        return Alternative(words, survey, judgement.words, ratio, judgement.reached, move)
    check = judged(survey, Tolerances(dict.fromkeys(survey.target_names, np.inf)), built)
    rules = f"it breaks a rule ({words_of(broken)}); " if broken else ""
    if not check.radius or check.unseen:
        return Alternative(words, survey, rules + check.remaining, np.inf, False, move)
    worst = max(check.radius, key=lambda name: check.radius[name])
    size = check.radius[worst]
    text = f"{rules}worst {worst}, within {size / MICROMETRE:.1f} um at 95 %"
    return Alternative(words, survey, text, size, not broken, move)
