"""Where to put the tripod, and what to measure next."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ltsim.api.files import RecordingSource, recording_of
from ltsim.effects.signature import Signature
from ltsim.plan.planner import Plan, make_plan
from ltsim.plan.spec import load_plan
from ltsim.remedies.next_measurement import NextMeasurement, Progress, next_measurement as proposals_of, quiet


def plan(
    source: str | Path = "paper-workshop",
    *,
    starts: int | None = None,
    seed: int | None = None,
    jobs: int = 1,
    progress: Progress = quiet,
) -> Plan:
    """Find a layout of stations and reflectors, with its reasons and its curve of cost against quality.

    Parameters
    ----------
    source : str or Path
        A plan file, a scenario file, or the name of a built-in one.
    starts : int, optional
        Independent searches; default as the file says.
    seed : int, optional
        Root of the search; default as the file says.
    jobs : int
        Processes; the plan does not depend on it.
    progress : callable
        Told what is done and the share of it.

    Raises
    ------
    SetupError
        In one sentence, for a plan that cannot be made.

    Examples
    --------
    >>> import ltsim as lt
    >>> made = lt.plan("small-plan.toml")
    >>> made.to_pandas("stations").shape
    (3, 6)
    """
    file, scenario = load_plan(source)
    changes = {key: value for key, value in (("seed", seed), ("starts", starts)) if value is not None}
    file = file.model_copy(update={"search": file.search.model_copy(update=changes)})
    return make_plan(file, scenario, jobs=jobs, progress=progress)


def next_measurement(
    recording: RecordingSource,
    *,
    between: Sequence[str] = (),
    beside: Sequence[Signature] = (),
    minutes_per_move: float = 20.0,
    progress: Progress = quiet,
) -> NextMeasurement:
    """Rank further measurements after a recording.

    Parameters
    ----------
    recording : Recording, str or Path
    between : sequence of str
        Names of two or more effects to decide between; none: by what is told about the instrument's parameters.
    beside : sequence of Signature
        What has been found already beside the question.
    minutes_per_move : float
        What it costs to move the tripod.
    progress : callable
        Told what is done and the share of it.

    Raises
    ------
    ModelError
        When an effect does not exist or cannot be fitted to this recording.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> proposals = lt.next_measurement(recording)
    >>> proposals.proposals[0].sharper < 1
    True
    """
    seen = recording_of(recording)
    return proposals_of(
        seen, between=tuple(between), beside=beside, minutes_per_move=minutes_per_move, progress=progress
    )
