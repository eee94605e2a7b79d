"""A calibrator of one's own: a program, or a function, that takes a recording and gives parameters.

The program is called with the folder of a recording and the name of a file to write, which holds
(`ltsim-estimates/1`; a `calibration.json` will do as well)

    {"format": "ltsim-estimates/1",
     "parameters": [{"name": "beam-tilt", "value": 5.9, "sigma": 2.5, "unit": "urad"},
                    {"name": "head-sag:sag", "value": 3.1, "unit": "urad"}]}

A parameter without a sigma can be held against a tolerance only.
"""

from __future__ import annotations

import json
import shlex
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

from pydantic import Field, TypeAdapter, ValidationError

from ltsim.errors import RecordError, SetupError
from ltsim.recording import Recording, write as write_recording
from ltsim.recording.files import shown
from ltsim.recording.setup import Finite
from ltsim.units import FACTOR

RECORDING, OUT = "{recording}", "{out}"


class Estimate(NamedTuple):
    """A parameter as a calibrator gives it, in a unit that `ltsim effects` lists."""

    value: Finite
    sigma: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None
    unit: str


Calibrator = str | Callable[[Recording], Mapping[str, Estimate | tuple[float, float | None, str]]]
"""A command with the words {recording} and {out}, or a function that gives value, sigma and unit by name."""
_ESTIMATES = TypeAdapter(dict[str, Estimate])


def checked_command(command: str) -> list[str]:
    """The words of a command; raises SetupError where it lacks a place for the recording or its answer."""
    for place in (RECORDING, OUT):
        if place not in command:
            raise SetupError(f"--calibrator '{shown(command)}' lacks {place}: expected 'CMD {RECORDING} {OUT}'")
    try:
        return shlex.split(command)
    except ValueError as problem:
        raise SetupError(f"--calibrator '{shown(command)}': {problem}") from None


def estimates_by(calibrator: Calibrator, recording: Recording, where: str) -> dict[str, Estimate] | None:
    """What a calibrator makes of a recording; None where it ends without a result (another status than 0, None).

    Raises SetupError or RecordError, naming `where`, when it cannot be started or gives what is not as documented.
    """
    if not isinstance(calibrator, str):
        given = calibrator(recording)
        return None if given is None else _checked(given, f"the calibrator's result of {where}")
    words = checked_command(calibrator)
    with TemporaryDirectory() as place:
        folder, out = Path(place) / "recording", Path(place) / "estimates.json"
        write_recording(recording, folder)
        filled = [word.replace(RECORDING, str(folder)).replace(OUT, str(out)) for word in words]
        try:
            done = subprocess.run(filled, capture_output=True, text=True, check=False)
        except OSError as problem:
            raise SetupError(f"--calibrator: {shown(words[0])} cannot be started ({problem.strerror})") from None
        if done.returncode:
            return None
        try:
            content = json.loads((out / "calibration.json" if out.is_dir() else out).read_text(encoding="utf-8"))
            listed = {e["name"]: [e["value"], e.get("sigma"), e["unit"]] for e in content["parameters"]}
        except (OSError, ValueError, KeyError, TypeError) as problem:
            raise RecordError(f"no list of parameters with name, value and unit ({problem!r})", file=where) from None
        return _checked(listed, where)


def _checked(given: object, where: str) -> dict[str, Estimate]:
    try:
        found = _ESTIMATES.validate_python(given)
    except ValidationError as problem:
        first = problem.errors()[0]
        place = " ".join(str(part) for part in first["loc"])
        raise RecordError(f"{place}: {first['msg']}; expected value, sigma and unit by name", file=where) from None
    lost = next((entry.unit for entry in found.values() if entry.unit not in FACTOR), None)
    if lost is not None:
        raise RecordError(f"'{shown(lost)}' is no unit, expected one of {', '.join(FACTOR)}", file=where)
    if not found:
        raise RecordError("holds no parameter, expected one or more", file=where)
    return found
