"""Examined programs: ltsim, alternatives that users have, or any command; each receives only a recording's folder."""

import contextlib
import io
import json
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from .make import RECORDINGS

STATUS = "status.json"
LEVEL = 0.05
LIMIT_S = 900.0
HUBER, HUBER_ROUNDS = 1.5, 8


def ltsim(recording: Path, out: Path) -> None:
    """Write the answer of `ltsim diagnose`.

    The cross-validation on held-out readings is omitted, because it does not change the reported findings.
    """
    import numpy as np

    import ltsim as lt

    from .measure import Model

    data = lt.read(str(recording))
    diagnosis = lt.diagnose(data, held_out=False)
    lt.write(diagnosis, out)
    change, factors = diagnosis.modelled_reading_change(data), diagnosis.variance_factors
    notes = {"coefficients": diagnosis.n_effect_coefficients}
    Model(np.asarray(change), factors, diagnosis.modelled_length_change(data), notes).write(out)


def ideal(recording: Path, out: Path) -> None:
    """Write the answer of the ideal observer.

    The observer knows the hall without noise and the list of laws, but no drawn value.
    """
    from .ideal import answer as ideal_answer

    ideal_answer(recording, out)


def plain(recording: Path, out: Path) -> None:
    """Write the answer of the calibration of the instrument in a network adjustment, with its global test."""
    _write_calibration(recording, out, robust=False)


def snooping(recording: Path, out: Path) -> None:
    """Write the answer of the calibration with data snooping (Baarda 1968).

    Readings that fail the test are rejected, and each is tested again at the end.
    """
    _write_calibration(recording, out, robust=True)


def huber(recording: Path, out: Path) -> None:
    """Write the answer of the calibration by Huber's robust estimator (1964).

    Readings with residuals above 1.5 sigma have smaller weights, in iterated adjustments.
    """
    import numpy as np

    from ltsim.adjustment import adjust
    from ltsim.physics.model.construction import misalignment_construction

    data = _write_calibration(recording, out, robust=False)
    adjustment = adjust(data, misalignment_construction())
    for _ in range(HUBER_ROUNDS - 1):
        size = np.abs(np.nan_to_num(adjustment.residuals / data.reading_sigmas())) / HUBER
        adjustment = adjust(
            data, misalignment_construction(), sigma=data.reading_sigmas() * np.sqrt(np.maximum(size, 1.0))
        )
    _targets(out, data.targets, 1e3 * adjustment.state.target_points)


def gama(recording: Path, out: Path) -> None:
    """Write the answer of GNU Gama's `gama-local`.

    It uses the Cholesky algorithm, because the default algorithm loses points. Instrument constants and tilts are
    estimated by the calibration, and subtracted before.
    """
    import numpy as np
    from defusedxml import ElementTree
    from scipy.stats import chi2

    import ltsim as lt
    from ltsim.calibration.correct import corrected_readings
    from ltsim.geometry.polar import from_polar, swap_front_and_raw, to_polar
    from ltsim.geometry.rigid import rotation_about_z

    data = lt.read(str(recording))
    adjustment = lt.calibrate(data, advise=False)
    ideal = corrected_readings(data, adjustment.construction, adjustment.estimates[data.instrument])
    upright = np.stack(
        [rotation_about_z(-np.arctan2(r[1, 0], r[0, 0])) @ r for r in adjustment.adjustment.state.station_rotations]
    )
    local = from_polar(swap_front_and_raw(ideal, data.face))
    level = swap_front_and_raw(to_polar(np.einsum("nij,nj->ni", upright[data.station], local)), data.face)
    stations = {name: s.model_copy(update={"levelled": True}) for name, s in data.setup.stations.items()}
    setup = data.setup.model_copy(update={"stations": stations})
    lt.write(data.replace(setup=setup, readings=level), out / "network.gkf", format="gama-local")
    files = [str(out / "network.gkf"), "--xml", str(out / "adjusted.xml")]
    command = [EXECUTABLES["gama"], *files, "--algorithm", "cholesky", "--cov-band", "0"]
    subprocess.run(command, check=True, timeout=LIMIT_S, capture_output=True)
    adjusted = ElementTree.parse(out / "adjusted.xml").getroot()
    points = {p[0].text: [1e3 * float(c.text) for c in p[1:]] for p in adjusted.iterfind(".//{*}adjusted/{*}point")}
    _targets(out, data.targets, [points[name] for name in data.targets])
    squares, dof = (float(adjusted.findtext(f".//{{*}}{tag}")) for tag in ("sum-of-squares", "degrees-of-freedom"))
    _verdict(out, float(chi2.sf(squares, dof)))


def _write_calibration(recording: Path, out: Path, *, robust: bool) -> Any:
    """Recording; its targets after calibration and the global test before rejections are written.

    Programs of this kind report no cause, so the findings are empty.
    """
    import ltsim as lt

    data = lt.read(str(recording))
    adjustment = lt.calibrate(data, advise=False, robust=robust)
    adjustment.to_dataframe("targets").to_csv(out / "targets.csv", index=False)
    _verdict(out, float((lt.calibrate(data, advise=False) if robust else adjustment).fit.p_value))
    return data


def _verdict(out: Path, p: float) -> None:
    verdict = {"verdict": "mismatch" if p < LEVEL else "consistent", "global_test": {"p_value": p}, "findings": []}
    (out / "diagnosis.json").write_text(json.dumps({"format": "ltsim-diagnosis/1"} | verdict) + "\n", encoding="utf-8")


def _targets(out: Path, names: Sequence[str], places_mm: Any) -> None:
    rows = [f"{name},{x:.6f},{y:.6f},{z:.6f}" for name, (x, y, z) in zip(names, places_mm, strict=True)]
    (out / "targets.csv").write_text("\n".join(["target,x_mm,y_mm,z_mm", *rows]) + "\n", encoding="utf-8")


PROGRAMS: tuple[Callable[[Path, Path], None], ...] = (ltsim, plain, snooping, huber, gama, ideal)
ENTRANTS = {program.__name__: program for program in PROGRAMS}
EXECUTABLES = {"gama": "gama-local"}  # executables that must be on the PATH


def answer(work_folder: Path, name: str, command: str = "", jobs: int = 1) -> bool:
    """True after a program has diagnosed all recordings without an answer; False if the program is not installed.

    Answers are written to `answers/NAME`.
    """
    program = EXECUTABLES.get(name, "") if not command else ""
    if program and shutil.which(program) is None:
        print(f"{name}: skipped, because {program} is not on the PATH")
        return False
    folders = sorted(f for f in (work_folder / RECORDINGS).iterdir() if f.is_dir())
    open_folders = [f for f in folders if not (work_folder / "answers" / name / f.name / STATUS).is_file()]
    with ProcessPoolExecutor(jobs) as pool:
        list(
            pool.map(
                partial(_answer_recording, answers=work_folder / "answers" / name, name=name, command=command),
                open_folders,
            )
        )
    return True


def _answer_recording(recording: Path, answers: Path, name: str, command: str) -> None:
    out, start, note = answers / recording.name, time.perf_counter(), ""
    out.mkdir(parents=True, exist_ok=True)
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            if command:
                arguments = [part.format(recording=recording, out=out) for part in shlex.split(command)]
                subprocess.run(arguments, check=True, timeout=LIMIT_S, capture_output=True)
            else:
                ENTRANTS[name](recording, out)
        except Exception as problem:  # a program that fails has no answer; the other recordings are still diagnosed
            note = f"{type(problem).__name__}: {problem}"
    content: dict[str, Any] = {"seconds": time.perf_counter() - start, "problem": note}
    (out / STATUS).write_text(json.dumps(content) + "\n", encoding="utf-8")
