"""External calibrators: programs or functions of a user that estimate parameters from a recording.

A program is called with the folder of a recording and the name of a file to write: a `calibration.json`, or

    {"format": "ltsim-estimates/1",
     "parameters": [{"name": "beam-tilt", "value": 5.9, "sigma": 2.5, "unit": "urad"},
                    {"name": "head-sag:sag", "value": 3.1, "unit": "urad"}]}

An estimate without a sigma can be checked against a tolerance only.
"""

import os
import shlex
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

from pydantic import Field, TypeAdapter, ValidationError

from ltsim.core.errors import CalibratorError, InputError, RecordError, option_text
from ltsim.core.parallel import PYTHON_SAFE_PATH_ENVIRONMENT_VARIABLE
from ltsim.core.units import SI_PER_UNIT, permitted_units_text
from ltsim.recordings import Recording, write as write_recording
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.result_file import read_json
from ltsim.recordings.setup import Finite

MAX_QUOTED_LINE_LENGTH = 300
"""Largest number of characters that a message quotes from the last line printed by an external program."""
RECORDING_PLACEHOLDER = "{recording}"
"""Placeholder in a calibrator command that is replaced by the path of the recording."""
OUTPUT_PLACEHOLDER = "{out}"
"""Placeholder in a calibrator command that is replaced by the path of the output file."""


class ParameterEstimate(NamedTuple):
    """Estimate of one parameter by an external calibrator, in a unit that `ltsim effects` lists."""

    value: Finite
    """Estimated value."""
    sigma: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None
    """Standard deviation of the estimate; None if the calibrator declares none."""
    unit: str
    """Unit of value and standard deviation."""


ExternalCalibrator = str | Callable[[Recording], Mapping[str, ParameterEstimate | tuple[float, float | None, str]]]
"""External calibrator: a command with the words {recording} and {out}, or a function that returns value, sigma and unit
of each estimated parameter by its name.
"""
_ESTIMATES_ADAPTER = TypeAdapter(dict[str, ParameterEstimate])
"""Validator (pydantic) of the estimates of an external calibrator, by parameter name."""


def split_calibrator_command(command: str) -> list[str]:
    """List of the words of a command; raises InputError for a command without {recording} or {out}."""
    for place in (RECORDING_PLACEHOLDER, OUTPUT_PLACEHOLDER):
        if place not in command:
            expected = f"'CMD {RECORDING_PLACEHOLDER} {OUTPUT_PLACEHOLDER}'"
            raise InputError(
                f"{option_text('calibrator')} '{safe_excerpt(command)}' lacks {place}: expected {expected}"
            )
    try:
        return shlex.split(command)
    except ValueError as problem:
        raise InputError(f"{option_text('calibrator')} '{safe_excerpt(command)}': {problem}") from None


def run_external_calibrator(calibrator: ExternalCalibrator, recording: Recording) -> dict[str, ParameterEstimate]:
    """Estimates of an external calibrator from a recording, by name of the parameter.

    CalibratorError is raised for a calibrator without a valid result, for example exit status 1, None, no file or an
    infinite value. InputError is raised for a program that cannot be started.
    """
    if not isinstance(calibrator, str):
        given = calibrator(recording)
        if given is None:
            raise CalibratorError("the calibrator returned no result (None)")
        try:
            return _validated_estimates(given)
        except RecordError as problem:
            raise CalibratorError(f"the calibrator's result is not valid: {problem}") from None
    words = split_calibrator_command(calibrator)
    with TemporaryDirectory() as place:
        folder, out = Path(place) / "recording", Path(place) / "estimates.json"
        write_recording(recording, folder)
        filled = [
            word.replace(RECORDING_PLACEHOLDER, str(folder)).replace(OUTPUT_PLACEHOLDER, str(out)) for word in words
        ]
        try:
            environment = {
                name: value for name, value in os.environ.items() if name != PYTHON_SAFE_PATH_ENVIRONMENT_VARIABLE
            }  # without the variable that only concerns processes of ltsim
            done = subprocess.run(
                filled, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False, env=environment
            )
        except OSError as problem:
            message = f"{option_text('calibrator')}: {safe_excerpt(words[0])} cannot be started ({problem.strerror})"
            raise InputError(message) from None
        what = f"'{safe_excerpt(calibrator, MAX_QUOTED_LINE_LENGTH)}' ended with status {done.returncode}"
        lines = done.stderr.decode("utf-8", "replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        detail = (
            f"its last line was: {safe_excerpt(last, MAX_QUOTED_LINE_LENGTH)}" if last else "standard error is empty"
        )
        if done.returncode:
            raise CalibratorError(f"{what}; {detail}")
        try:
            return _validated_estimates(_read_estimates(out / "calibration.json" if out.is_dir() else out))
        except RecordError as problem:
            raise CalibratorError(f"{what}, but its result is not valid: {problem}; {detail}") from None


def _read_estimates(file: Path) -> dict[str, list[object]]:
    """Value, sigma and unit of each parameter by name, from the output file of a program; raises RecordError."""
    if not file.exists():
        raise RecordError(f"there is no file at {OUTPUT_PLACEHOLDER}")
    try:
        content = read_json(file, "list of parameters")
        return {e["name"]: [e["value"], e.get("sigma"), e["unit"]] for e in content["parameters"]}
    except RecordError as problem:
        place = f"the file at {OUTPUT_PLACEHOLDER}"  # the true path is that of a temporary folder
        text = str(problem).replace(f"{file}: the file", place, 1)
        raise RecordError(text.replace(str(file), place)) from None
    except KeyError as problem:
        raise RecordError(f"{problem} is missing; expected parameters with name, value and unit") from None
    except (OSError, TypeError, AttributeError):
        raise RecordError("the file contains no list of parameters with name, value and unit") from None


def _validated_estimates(raw_estimates: object) -> dict[str, ParameterEstimate]:
    """Validated estimates by name of the parameter; raises RecordError for an invalid estimate."""
    try:
        estimates = _ESTIMATES_ADAPTER.validate_python(raw_estimates)
    except ValidationError as problem:
        first = problem.errors()[0]
        name, *index = first["loc"] or ("the result",)
        fields = [ParameterEstimate._fields[at] for at in index if isinstance(at, int)]
        given, reason = safe_excerpt(repr(first["input"])), first["msg"].lower().replace("input", "it")
        where = " of ".join([*fields, str(name)])
        raise RecordError(f"{where} is {given}, {reason}; expected value, sigma and unit by name") from None
    lost = next((entry.unit for entry in estimates.values() if entry.unit not in SI_PER_UNIT), None)
    if lost is not None:
        raise RecordError(f"'{safe_excerpt(lost)}' is not a unit, expected one of {permitted_units_text()}")
    if not estimates:
        raise RecordError("the result contains no parameter, expected at least one")
    return estimates
