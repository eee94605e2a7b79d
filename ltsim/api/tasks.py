"""What measured points are worth: tasks, two epochs, go or no-go in the field, acceptance tests, reflectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ltsim.acceptance.accept import accept as accepted
from ltsim.acceptance.files import AcceptanceFile
from ltsim.acceptance.spec import Acceptance, acceptance_from, load_acceptance
from ltsim.adjustment import Adjustment, adjust
from ltsim.errors import ModelError
from ltsim.evaluation.bench import bench_file, evaluate_bench, read_bench
from ltsim.evaluation.schema import BenchFile
from ltsim.fieldcheck.check import Check, check as check_of
from ltsim.model.construction import ideal, stated_construction
from ltsim.recording.coordinates import Coordinates, holds_coordinates, read_coordinates
from ltsim.recording.exchange import RecordingSource, recording_of
from ltsim.recording.recording import Recording
from ltsim.tasks.congruence import Congruence
from ltsim.tasks.epochs import compare as compared, compare_coordinates
from ltsim.tasks.evaluation import Evaluation, evaluate_tasks
from ltsim.tasks.spec import FORMAT, Tasks, load_tasks, tasks_from
from ltsim.units import DEGREE, MICROMETRE


def uncertainty(recording: RecordingSource, tasks: str | Path | Mapping[str, Any] | Tasks) -> Evaluation:
    """Say how well tasks (lengths, angles, features, ...) are known: by propagation and by Monte Carlo, with budgets.

    Parameters
    ----------
    recording : Recording, str or Path
    tasks : str, Path, mapping or Tasks
        A task file, or its tables (``task``, ``type_b``, ...); `format` and `source` may be left out of tables.

    Raises
    ------
    ModelError, SetupError
        When a task names what does not exist or is not determined.

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
    given: Tasks
    if isinstance(tasks, Tasks):
        given = tasks
    elif isinstance(tasks, Mapping):
        given = tasks_from({"format": FORMAT, "source": "", **tasks}, "tasks")
    else:
        given = load_tasks(Path(tasks))
    return evaluate_tasks(recording_of(recording), given)


def compare(
    first: RecordingSource | Coordinates,
    second: RecordingSource | Coordinates,
    *,
    stable: Sequence[str] | None = None,
    free: bool = False,
    scaled: bool = False,
    same_instrument: bool = False,
    calibrate: bool = True,
    level: float = 0.05,
) -> Congruence:
    """Say which points moved between two recordings, and which motion could not have been seen.

    Parameters
    ----------
    first, second : Recording, Coordinates, str or Path
        Two recordings, or two lists of coordinates with their covariance (`ltsim.recording.coordinates`).
    stable : sequence of str, optional
        Points known not to have moved; they are not tested. Default: found by the test.
    free : bool
        Of lists alone: their frames differ, the second may move as a whole.
    scaled : bool
        Let the second recording have a scale of its own: another temperature, another instrument.
    same_instrument : bool
        One tracker with the same errors measured both: what its maker's guarantee leaves open then shifts both epochs
        alike and does not count as a difference.
    calibrate : bool
        Estimate the instrument's constants in each recording.
    level : float
        Probability that any point is told to have moved when none did.

    Examples
    --------
    >>> import ltsim as lt
    >>> january, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.compare(january, january, same_instrument=True).moved
    ()
    """
    lists = [one for one in (_coordinates_of(first), _coordinates_of(second)) if one is not None]
    if len(lists) == 2:
        return compare_coordinates(*lists, stable=stable, free=free, scaled=scaled, level=level)
    if lists or free:
        raise ModelError("a list of coordinates is compared with another one alone, and free frames are theirs")

    def adjusted(recording: Recording) -> Adjustment:
        found = adjust(recording, stated_construction(recording) if calibrate else ideal())
        found.solution.require_success()
        return found

    epochs = [adjusted(recording_of(one)) for one in (first, second) if not isinstance(one, Coordinates)]
    return compared(*epochs, stable=stable, scaled=scaled, same_instrument=same_instrument, level=level)


def _coordinates_of(source: RecordingSource | Coordinates) -> Coordinates | None:
    """The list of coordinates itself, read where a path leads to one; None for a recording."""
    if isinstance(source, Coordinates):
        return source
    return (
        read_coordinates(Path(source)) if isinstance(source, str | Path) and holds_coordinates(Path(source)) else None
    )


def check(recording: RecordingSource, *, level: float = 0.01) -> Check:
    """Go or no-go in the field: two-face differences, repeated points, drift, bumps and scatter.

    Parameters
    ----------
    recording : Recording, str or Path
    level : float
        Chance of one false alarm in the whole recording.

    Raises
    ------
    NetworkError
        When nothing was measured twice.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.check(recording).passed
    True
    """
    return check_of(recording_of(recording), level=level)


def accept(acceptance: str | Path | Mapping[str, Any] | Acceptance, folder: str | Path = ".") -> AcceptanceFile:
    """Predict acceptance tests of a tracker, or judge errors that were found, against its maker's limits.

    Parameters
    ----------
    acceptance : str, Path, mapping or Acceptance
        An acceptance file, or its tables; `format` may be left out of tables.
    folder : str or Path
        From where tables name other files.

    Raises
    ------
    SetupError, RecordError, NetworkError
        When a file is missing or does not fit the plan of tests.

    Examples
    --------
    >>> import ltsim as lt
    >>> found = lt.accept({"standard": "asme-b89.4.19-2006", "instrument": "leica-at500"})
    >>> found.kind, len(found.tests)
    ('predicted', 74)
    """
    if isinstance(acceptance, Acceptance):
        return accepted(acceptance, Path(folder))
    if isinstance(acceptance, Mapping):
        return accepted(acceptance_from({"format": "ltsim-acceptance/1", **acceptance}, "acceptance"), Path(folder))
    return accepted(load_acceptance(Path(acceptance)), Path(acceptance).parent)


def bench(source: str | Path, *, probe_direction: float = 90.0, length_sigma: float = 0.1) -> BenchFile:
    """Find a reflector's range error against incidence from its test on a roundness table.

    Parameters
    ----------
    source : str or Path
        A table ``angle_deg,length_um,probe_um``; cells are empty where one of them was not read.
    probe_direction : float, [deg]
        Where the probe stands, from the interferometer.
    length_sigma : float, [um]
        Standard deviation of the interferometer.

    Raises
    ------
    RecordError
        When the table is malformed, or holds too few angles.

    Examples
    --------
    >>> import ltsim as lt
    >>> from pathlib import Path
    >>> rows = [[str(a), str(0.1 * a) if abs(a) <= 30 else "", "0.0"] for a in range(-180, 180, 15)]
    >>> lines = [",".join(row) for row in [["angle_deg", "length_um", "probe_um"], *rows]]
    >>> _ = Path("reflector.csv").write_text(chr(10).join(lines))
    >>> [round(row.error_um, 1) for row in lt.bench("reflector.csv").table]
    [-3.0, -1.5, 0.0, 1.5, 3.0]
    """
    how = {"probe_direction": probe_direction * DEGREE, "length_sigma": length_sigma * MICROMETRE}
    record = read_bench(Path(source), **how)
    return bench_file(record, evaluate_bench(record))
