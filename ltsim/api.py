"""Public functions that read recordings and results from files, and write and convert them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ltsim.core.arguments import check_argument_bounds
from ltsim.core.errors import ModelError, RecordError
from ltsim.recordings import Recording, read as read_recording, write as write_recording
from ltsim.recordings.exchange import RecordingSource, is_supported_recording
from ltsim.recordings.hints import HintsArgument
from ltsim.recordings.native import OBSERVATIONS_FILE
from ltsim.recordings.result_file import ResultFile, read_json, read_result, write_result


def read(path: str | Path, *, format: str | None = None, hints: HintsArgument = None) -> Any:  # noqa: A002
    """Recording in any format, or result that a command or `lt.write` wrote.

    A file is data: it is checked against the model of its format, and nothing that it names is imported or run.

    Parameters
    ----------
    path : str or Path
        Folder or file.
    format : str, optional
        Name of the format of a recording; default by content, then by suffix.
    hints : Hints or mapping, optional
        Interpretation of an ambiguous recording, such as the unit of its angles: ``{"angle": "gon"}``. The keys and
        values are those of the option `--hint` and, as `columns`, of `--columns`.

    Returns
    -------
    Recording, or the result
        `notes` of a recording report how ambiguous conventions were interpreted, and rows that were not used. From a
        folder with a recording and results the recording is read; to read a result, give the path of its file.

    Raises
    ------
    RecordError
        If the file is invalid or ambiguous; the message states what is wrong and where, or the required hint.
    InputError
        If a hint is invalid.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.write(recording, "my-recording")
    >>> lt.read("my-recording")
    Recording: The paper's workshop: 140 pointings, 5 stations, 28 targets, face 1 only, 6 known lengths
    >>> lt.write(lt.calibrate(recording), "my-calibration")
    >>> len(lt.read("my-calibration").instrument_parameter_names)
    16
    """
    place = Path(path)
    result = _find_result_file(place) if format is None else None
    if result is not None:
        return _read_result(result)
    return read_recording(place, format=format, hints=hints)


def _find_result_file(file_or_folder: Path) -> Path | None:
    """Path of the result file `file_or_folder`, or of the result file in this folder; None for a recording."""
    if file_or_folder.is_file():
        return (
            file_or_folder if file_or_folder.suffix == ".json" and not is_supported_recording(file_or_folder) else None
        )
    if (file_or_folder / OBSERVATIONS_FILE).is_file():
        return None
    from ltsim.reports.schemas import MODEL_BY_FILE_NAME  # which takes a second

    return next(
        (
            file_or_folder / name
            for name in MODEL_BY_FILE_NAME
            if name.endswith(".json") and (file_or_folder / name).is_file()
        ),
        None,
    )


def _read_result(file: Path) -> Any:
    """Result read from a file that a command or `write` wrote."""
    from ltsim.calibration.calibration import Calibration
    from ltsim.calibration.files import read_calibration
    from ltsim.reports.schemas import RESULT_MODELS

    kind = str(read_json(file, "result of ltsim").get("format", ""))
    if kind == Calibration.model_fields["format"].default:
        return read_calibration(file)
    if kind.startswith("ltsim-campaign-rows/"):
        from ltsim.campaigns.results import CampaignResults

        return CampaignResults(file.parent)  # the rows beside the manifest
    model = next((m for m in RESULT_MODELS if m.model_fields["format"].default == kind), None)
    if model is None:
        raise RecordError("the path is no recording and no result of ltsim", file=file)
    return read_result(file, model)


def write(
    result: Recording | ResultFile,
    path: str | Path,
    *,
    format: str = "native",  # noqa: A002
    recording: Recording | None = None,
    with_stations: bool = False,
) -> None:
    """Write a recording or a result to the files that the command for it writes; true values are a single file.

    Parameters
    ----------
    result : Recording, or result of a command that writes files
    path : str or Path
        Path of the folder or file; existing files are replaced.
    format : str
        Format of a recording: `native`, or another format that can be written.
    recording : Recording, optional
        Recording from which a diagnosis was computed; it is written to the same folder for the report.
    with_stations : bool
        True to write also `points.csv` and `points.covariance.csv`, the targets and stations of an adjustment,
        calibration or diagnosis with their joint covariance, for `uncertainty` and `compare`.

    Raises
    ------
    ModelError
        If the object is neither a recording nor a result, or is a result that was read without arrays for its tables.
    RecordError
        If the path cannot be written; no partial files remain.

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
        _write_result(result, Path(path), recording, with_stations=with_stations)


def _write_result(result_file: ResultFile, path: Path, recording: Recording | None, *, with_stations: bool) -> None:
    """Writing of a result that is not a recording; `recording` is written to the same folder if given.

    With `with_stations` the files of targets and stations are written too.
    """
    from ltsim.calibration.calibration import Calibration
    from ltsim.calibration.files import write_calibration
    from ltsim.diagnosis.diagnosis import Diagnosis
    from ltsim.diagnosis.files import write_diagnosis
    from ltsim.planning.result import Plan, write_plan
    from ltsim.simulation.truth import Truth, write_truth

    match result_file:
        case Truth():
            write_truth(result_file, path)
        case Calibration():
            write_calibration(result_file, path, with_stations=with_stations)
        case Diagnosis():
            write_diagnosis(result_file, path, recording, with_stations=with_stations)
        case Plan():
            write_plan(result_file, path)
        case ResultFile():
            write_result(path, result_file)
        case _:
            raise ModelError(
                f"a {type(result_file).__name__} cannot be written; expected a recording, a calibration or other result"
            )


def convert(
    source: RecordingSource,
    destination: str | Path,
    *,
    to: str = "native",
    format: str | None = None,  # noqa: A002
    hints: HintsArgument = None,
    every: int = 1,
) -> Recording:
    """Read a recording in one format and write it in another.

    Parameters
    ----------
    source : Recording, str or Path
    destination : str or Path
    to : str
        Format to write.
    format, hints
        Format and interpretation of the source, as for `read`.
    every : int
        Number N: only every N-th pointing from a station to a target in one face is written. Long monitoring recordings
        contain more pointings than a network needs.

    Returns
    -------
    Recording
        Recording as written. Its `notes` report how an ambiguous file was interpreted.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.convert(recording, "workshop.txt", to="polar-text")
    Recording: The paper's workshop: 140 pointings, 5 stations, 28 targets, face 1 only, 6 known lengths
    """
    check_argument_bounds(every=every, required_argument="every")
    recording = source if isinstance(source, Recording) else read_recording(source, format=format, hints=hints)
    recording = recording if every == 1 else recording.thin(every)
    write_recording(recording, destination, to)
    return recording
