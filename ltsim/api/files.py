"""Recordings and results in and out of files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ltsim.errors import ModelError
from ltsim.recording import Hints, Recording, read as read, write as write_recording
from ltsim.recording.exchange import RecordingSource

if TYPE_CHECKING:
    from ltsim.calibration.calibration import Calibration
    from ltsim.diagnosis.diagnosis import Diagnosis
    from ltsim.planning.planner import Plan
    from ltsim.simulation.truth import Truth


def write(
    result: Recording | Truth | Calibration | Diagnosis | Plan,
    path: str | Path,
    *,
    format: str = "native",  # noqa: A002
    recording: Recording | None = None,
) -> None:
    """Write a recording or a result as the command of its name does: a folder, for a truth a file.

    Parameters
    ----------
    result : Recording, Truth, Calibration, Diagnosis or Plan
    path : str or Path
        Of the folder or file; what is there is replaced.
    format : str
        Of a recording: `native`, or another format that can be written.
    recording : Recording, optional
        What a diagnosis was found from, to lie beside it for its report.

    Raises
    ------
    ModelError
        When the object is none of these.
    RecordError
        When the place cannot be written; nothing half-written stays behind.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, truth = lt.simulate("paper-workshop", seed=7)
    >>> lt.write(recording, "workshop.txt", format="polar-text")
    >>> lt.write(truth, "truth.json")
    """
    if isinstance(result, Recording):
        write_recording(result, path, format)
    else:
        _write_result(result, Path(path), recording)


def _write_result(result: Truth | Calibration | Diagnosis | Plan, path: Path, recording: Recording | None) -> None:
    """What is no recording; its room is loaded already, since the result came from it."""
    from ltsim.calibration import Calibration, write_calibration
    from ltsim.diagnosis import Diagnosis
    from ltsim.diagnosis.files import write_diagnosis
    from ltsim.planning.files import write_plan
    from ltsim.planning.planner import Plan
    from ltsim.simulation.truth import Truth, write_truth

    match result:
        case Truth():
            write_truth(result, path)
        case Calibration():
            write_calibration(result, path)
        case Diagnosis():
            write_diagnosis(result, path, recording)
        case Plan():
            write_plan(result, path)
        case _:
            raise ModelError(f"a {type(result).__name__} has no files; a recording, truth, calibration, ... has")


def convert(
    source: RecordingSource,
    destination: str | Path,
    *,
    to: str = "native",
    format: str | None = None,  # noqa: A002
    hints: Hints | None = None,
) -> Recording:
    """Read a recording in one format and write it in another.

    Parameters
    ----------
    source : Recording, str or Path
    destination : str or Path
    to : str
        Format to write.
    format, hints
        As of `read`.

    Returns
    -------
    Recording
        Its `notes` say what was decided about an ambiguous file.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.convert(recording, "workshop.txt", to="polar-text")
    Recording: The paper's workshop: 140 pointings, 5 stations, 28 targets, face 1 only, 6 known lengths
    """
    recording = source if isinstance(source, Recording) else read(source, format=format, hints=hints)
    write_recording(recording, destination, to)
    return recording
