"""Public functions `uncertainty` (tasks on measured points) and `compare` (displacements between two epochs)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ltsim.calibration.identified_network import IdentifiedNetwork
from ltsim.core.arguments import check_argument_bounds
from ltsim.core.errors import ConvergenceError, ModelError, NetworkError, option_text
from ltsim.measurands.comparison import Comparison
from ltsim.measurands.epochs import compare_adjustments, compare_coordinates
from ltsim.measurands.evaluation import evaluate_tasks, evaluate_tasks_on_coordinates
from ltsim.measurands.spec import TASKS_FORMAT, Tasks, load_tasks, validate_tasks
from ltsim.measurands.uncertainty import Uncertainty
from ltsim.physics.effects.verbs import name_tuple
from ltsim.physics.model.construction import declared_construction, ideal_construction
from ltsim.recordings.coordinates import is_coordinate_file, read_coordinates
from ltsim.recordings.epoch_coordinates import EpochCoordinates
from ltsim.recordings.exchange import RecordingSource, load_recording
from ltsim.recordings.recording import Recording


def uncertainty(
    recording: RecordingSource | EpochCoordinates,
    tasks: str | Path | Mapping[str, Any] | Tasks,
    *,
    seed: int | None = None,
) -> Uncertainty:
    """Uncertainty of tasks (lengths, angles, features and others) by propagation and Monte Carlo, with budgets.

    Parameters
    ----------
    recording : Recording, EpochCoordinates, str or Path
        Recording, or list of coordinates with their joint covariance, such as `targets.csv` of `adjust` with
        `targets.covariance.csv` in its folder.
    tasks : str, Path, mapping or Tasks
        Task file, or its tables (``task``, ``type_b``, ...); tables need no `format` and `source`.
    seed : int, optional
        Seed of all random draws; default from the task file.

    Raises
    ------
    ModelError, InputError
        When a task names a target or effect that does not exist, or a target that the readings do not determine.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> length = {"name": "length", "kind": "distance", "targets": ["T01", "T12"]}
    >>> found = lt.uncertainty(recording, {"task": [length], "monte_carlo": {"digits": 1}})
    >>> found.to_dataframe()[["task", "result", "unit"]]
         task    result unit
    0  length  distance   mm
    """
    check_argument_bounds(seed=seed)
    given: Tasks
    if isinstance(tasks, Tasks):
        given = tasks
    elif isinstance(tasks, Mapping):
        given = validate_tasks({"format": TASKS_FORMAT, "source": "", **tasks}, "tasks")
    else:
        given = load_tasks(Path(tasks))
    if seed is not None:
        given = given.model_copy(update={"monte_carlo": given.monte_carlo.model_copy(update={"seed": seed})})
    coordinates = _load_coordinates(recording, allows_fixed=True)
    if coordinates is not None:
        return evaluate_tasks_on_coordinates(coordinates, given).to_result
    return evaluate_tasks(load_recording(recording), given).to_result  # type: ignore[arg-type]


def compare(
    first: RecordingSource | EpochCoordinates,
    second: RecordingSource | EpochCoordinates,
    *,
    stable: str | Sequence[str] | None = None,
    free: bool = False,
    scaled: bool = False,
    same_instrument: bool = False,
    calibrate: bool = True,
    robust: bool = False,
    level: float = 0.05,
) -> Comparison:
    """Comparison of two epochs by a congruence test: displaced points, and minimal detectable displacements.

    Parameters
    ----------
    first, second : Recording, EpochCoordinates, str or Path
        Two recordings, or two lists of coordinates with their covariance (`ltsim.recordings.coordinates`).
    stable : str or sequence of str, optional
        Names of points that are certain not to have moved; they are not tested. By default the test determines which
        points are stable.
    free : bool
        True if two lists of coordinates have different frames, so that the second is aligned to the first.
    scaled : bool
        True to estimate the scale of the second epoch, which another temperature or instrument may have changed.
    same_instrument : bool
        True if one tracker with unchanged errors measured both recordings. Errors that the readings do not determine
        then displace both epochs equally, and do not count as differences.
    calibrate : bool
        True to estimate the instrument parameters in each recording.
    robust : bool
        True to exclude outlying readings; each excluded reading is tested again at the end.
    level : float
        Significance level: probability that at least one point is reported as moved although none moved.

    Raises
    ------
    ModelError
        When a stable point is not a common point, or when lists of coordinates are given with an option for recordings.
    NetworkError
        When the epochs have too few common points, or a network cannot be solved.

    Examples
    --------
    >>> import ltsim as lt
    >>> january, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.compare(january, january, same_instrument=True).moved_points
    ()
    """
    check_argument_bounds(level=level, required_argument="level")
    lists = [
        coordinates
        for source in (first, second)
        if (coordinates := _load_coordinates(source, requires_sigmas=False)) is not None
    ]
    stable_names = None if stable is None else name_tuple(stable)
    if lists and (same_instrument or robust or not calibrate):
        asked = ", ".join(option_text(name) for name in ("same_instrument=True", "robust=True", "calibrate=False"))
        raise ModelError(f"lists of coordinates contain no readings, so {asked} have no effect")
    if len(lists) == 2:
        return compare_coordinates(
            *lists, stable_names=stable_names, has_free_motions=free, with_scale=scaled, alpha=level
        )
    if lists:
        raise ModelError("a list of coordinates can be compared only with another list of coordinates")
    if free:
        raise ModelError(
            f"{option_text('free=True')} is for lists of coordinates: a recording declares its free motions"
        )

    def adjust_epoch(recording: Recording, epoch_name: str) -> IdentifiedNetwork:
        construction = declared_construction(recording) if calibrate else ideal_construction()
        try:
            return IdentifiedNetwork.from_recording(recording, construction, robust=robust)
        except NetworkError as problem:
            raise NetworkError(f"the {epoch_name} recording: {problem}") from problem
        except ConvergenceError as problem:
            raise ConvergenceError(f"the {epoch_name} recording: {problem}", problem.solution) from problem

    epochs = [
        adjust_epoch(load_recording(source), name)
        for source, name in ((first, "first"), (second, "second"))
        if not isinstance(source, EpochCoordinates)
    ]
    before, after = epochs
    comparison = compare_adjustments(
        before.adjustment,
        after.adjustment,
        stable_names=stable_names,
        with_scale=scaled,
        same_instrument=same_instrument,
        alpha=level,
    )
    notes = [
        *(f"In the first epoch: {sentence}" for sentence in before.sentences),
        *(f"In the second epoch: {sentence}" for sentence in after.sentences),
        *comparison.notes,
    ]
    return comparison.model_copy(
        update={
            "recording": before.recording_entry,
            "second_recording": after.recording_entry,
            "notes": tuple(notes),
            "tests": before.tests,
            "second_tests": after.tests,
        }
    )


def _load_coordinates(
    source: RecordingSource | EpochCoordinates, *, allows_fixed: bool = False, requires_sigmas: bool = True
) -> EpochCoordinates | None:
    """List of coordinates, read from the file `source` if it is the path of such a list; None for a recording.

    With `allows_fixed`, coordinates that define the frame may have the variance 0. Unless `requires_sigmas`, the list
    may have no standard deviations.
    """
    if isinstance(source, EpochCoordinates):
        return source
    return (
        read_coordinates(Path(source), allows_fixed=allows_fixed, requires_sigmas=requires_sigmas)
        if isinstance(source, str | Path) and is_coordinate_file(Path(source))
        else None
    )
