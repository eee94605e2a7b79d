"""Real tracker: calibration from one set-up, validation at the other, changes over nine epochs.

    python -m experiments 11 [noise] [course] [transfer] [lines] [index] [checks] [diagnoses]

The steps read ../shared/recordings, and write only results.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.common import Options, RunRecord, run_steps, show_table, write_figure
from ltsim.adjustment import adjust
from ltsim.adjustment.fieldcheck.setup_model import two_face_pairs
from ltsim.calibration.calibration_series import CalibrationSeries
from ltsim.calibration.history import History
from ltsim.calibration.network import calibrate_network
from ltsim.core.arrays import Floats
from ltsim.diagnosis.diagnose import diagnose
from ltsim.geometry.polar import from_polar
from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.setup import Noise

from .desy import (
    AUTHORS,
    EPOCHS,
    epoch,
    estimated_noise,
    interferometer,
    is_clean_pair,
    reject_outliers,
    set_up,
    variance_factors,
)

FLIPPING = ("transit-offset", "beam-offset", "beam-tilt", "transit-tilt", "vertical-index")
DEFAULT = "what `calibrate` applies by default"
SIX = misalignment_construction([effect for effect in ORDINARY_CALIBRATION_EFFECTS if effect.name in FLIPPING])
UNITS = ("um", "urad across", "urad elevation")
COLUMNS_BEFORE, COLUMNS_AFTER = ([f"{when} {unit}" for unit in UNITS] for when in ("before", "after"))
Rows = list[dict[str, object]]


def noise_of_recordings(out: Path) -> Noise:
    """Noise in `noise.json`, which is estimated first if the file does not exist."""
    file = out / "noise.json"
    if not file.is_file():
        noise(out)
    return Noise(**json.loads(file.read_text())["estimated"])


def noise(out: Path) -> None:
    """Estimate the noise of the recordings, and list chi-square, variance factors and rejected pairs of each epoch."""
    estimate = estimated_noise()
    text = json.dumps({"estimated": estimate.model_dump(), "authors": AUTHORS.model_dump()}, indent=1)
    (out / "noise.json").write_text(text + "\n")
    rows: Rows = []
    for name in EPOCHS:
        used, dropped = reject_outliers(epoch(name, estimate))
        adjusted = adjust(used, misalignment_construction())
        factors = variance_factors([adjusted])
        by_authors = adjust(reject_outliers(epoch(name, AUTHORS))[0], misalignment_construction())
        rows.append({"epoch": name, "pointings": len(used), "chi2/dof": round(adjusted.sigma0**2, 3),
                     "range factor": factors[0].round(2), "azimuth factor": factors[1].round(2),
                     "elevation factor": factors[2].round(2), "chi2/dof authors": round(by_authors.sigma0**2, 3),
                     "pairs left out": "; ".join(f"{station} {target} {OBSERVABLES[k]} w={w:.1f}"
                                                 for station, target, k, w in dropped)})  # fmt: skip
    show_table(out / "noise.csv", rows)


def course(out: Path) -> None:
    """Calibrate every epoch with 16 and with 6 parameters, and list the parameters and their changes."""
    estimate = noise_of_recordings(out)
    recordings = {name: reject_outliers(epoch(name, estimate))[0] for name in EPOCHS}
    for label, construction in (("16", misalignment_construction()), ("6", SIX)):
        calibrations = [
            (name, calibrate_network(recordings[name], construction, recommend_measurements=False)) for name in EPOCHS
        ]
        history = History.from_series(CalibrationSeries.from_labelled(calibrations))
        content = history.content()
        (out / f"history_{label}.json").write_text(json.dumps(content, indent=1) + "\n")
        if construction is SIX:  # a figure of sixteen parameters would not be readable
            write_figure(out / f"history_{label}.svg", history.plot())
        show_table(out / f"changes_{label}.csv", [
            {"from": c["from"], "to": c["to"], "chi2": round(c["chi2"], 1), "dof": c["dof"],
             "p": f"{c['p_value']:.1e}", "changed": " ".join(c["changed_parameters"])}
            for c in [*content["changes"], content["change_since_first"]]
        ])  # fmt: skip
        show_table(out / f"course_{label}.csv", [
            {"parameter": p["name"], "unit": p["unit"],
             **{name: f"{v:.2f} +- {s:.2f}" for name, v, s in zip(EPOCHS, p["values"], p["sigmas"], strict=True)},
             "mean": round(p["mean"], 2), "spread": round(p["between_calibration_sigma"], 2),
             "p constant": f"{p['constancy_test']['p_value']:.1e}"}
            for p in content["parameters"]
        ])  # fmt: skip


CEILING = "ceiling: 16 parameters on the set-up they were fitted to"
"""Name of the method that removes parameters from the pairs of faces from which they were estimated: an upper limit for
every method.
"""
METHODS = (
    ("16 parameters", misalignment_construction(), False, False),
    (DEFAULT, misalignment_construction(), False, False),
    ("16 parameters, outliers out", misalignment_construction(), True, False),
    ("16 parameters, outliers out, history of other epochs", misalignment_construction(), True, True),
    ("6 parameters", SIX, False, False),
    ("6 parameters, outliers out", SIX, True, False),
    (CEILING, misalignment_construction(), True, False),
)
"""Name; construction; True if outliers of the calibrating set-up are rejected; True if other epochs provide the prior.
"""


def transfer(out: Path) -> None:
    """Evaluate half face differences of each set-up before and after correction by the other set-up's parameters."""
    estimate, parts = noise_of_recordings(out), []
    raw = {(name, s): set_up(epoch(name, estimate), s) for name in EPOCHS for s in (0, 1)}
    good = {key: is_clean_pair(two_face_pairs(r), r) for key, r in raw.items()}
    for method, construction, snoop, informed in METHODS:
        used = {k: reject_outliers(r, construction)[0] if snoop else r for k, r in raw.items()}
        calibrations = {k: calibrate_network(r, construction, recommend_measurements=False) for k, r in used.items()}
        for name, s in raw:
            others = [(f"{k[0]} {k[1]}", c) for k, c in calibrations.items() if k[0] != name]
            calibration = calibrations[name, s]
            if informed:
                calibration = CalibrationSeries.from_labelled(others).with_population_prior(calibration)
            to = s if method == CEILING else 1 - s
            values = calibration.applied_values[0] if method == DEFAULT else calibration.estimates[0]
            faces = two_face_pairs(raw[name, to]), two_face_pairs(raw[name, to], construction, values)
            columns = np.hstack([(1e6 * half.half_differences) ** 2 for half in faces])
            about = {"method": method, "epoch": name, "from": s, "to": to, "clean": good[name, to]}
            parts.append(pd.DataFrame(columns, columns=[*COLUMNS_BEFORE, *COLUMNS_AFTER]).assign(**about))
    pairs = pd.concat(parts)
    clean_pairs = pairs[pairs.clean]
    every = shares(clean_pairs, "clean", "method", "epoch", "from", "to")
    total = [shares(pairs, "all", "method"), shares(clean_pairs, "clean", "method")]
    for kind, whole in zip((pairs, clean_pairs), total, strict=True):
        medians = shares(kind, "", "method", "epoch", "from", digits=9).groupby("method").median(numeric_only=True)
        for direction in ("across", "elevation"):
            whole[f"median share {direction}"] = whole.method.map(medians[f"share {direction}"]).round(3)
    order = pd.concat(total).sort_index(kind="stable")
    show_table(out / "transfer.csv", every[every.method != CEILING].to_dict("records"))
    show_table(out / "transfer_summary.csv", order.to_dict("records"))


def shares(pairs: pd.DataFrame, kind: str, *keys: str, digits: int = 3) -> pd.DataFrame:
    """Rms half face differences [um, urad] before and after correction, and the fraction removed, for each group."""
    groups = pairs.groupby([*keys], sort=False)
    rms, table = (
        groups[[*COLUMNS_BEFORE, *COLUMNS_AFTER]].mean() ** 0.5,
        groups.size().map(f"{{}} {kind}".format).to_frame("pairs"),
    )
    for before, after, unit in zip(COLUMNS_BEFORE, COLUMNS_AFTER, UNITS, strict=True):
        table[before], table[after] = rms[before].round(2), rms[after].round(2)
        table[f"share {unit.split()[-1]}"] = (1 - rms[after] / rms[before]).round(digits)
    return table.reset_index()


def lines(out: Path) -> None:
    """Compare interferometer lengths with lengths from coordinates: of the network, and of one face of one set-up."""
    estimate, parts, back = noise_of_recordings(out), [], []
    for name in EPOCHS:
        recording = reject_outliers(epoch(name, estimate))[0]
        spans = interferometer(name)
        back.append(spans.groupby("way").length.diff().dropna())
        calibrated = adjust(recording, misalignment_construction())
        places = {
            "network, as read": adjust(recording).state.target_points,
            "network, calibrated": calibrated.state.target_points,
        }
        parts += [gaps(spans, recording.targets, points).assign(coordinates=how) for how, points in places.items()]
        for s in (0, 1):
            setup, calibration = (
                set_up(recording, s),
                calibrate_network(set_up(recording, 1 - s), recommend_measurements=False),
            )
            for face in (1, 2):
                pointings = setup.select(setup.face == face)
                names = [pointings.targets[t] for t in pointings.target]
                single = {
                    "as read": from_polar(pointings.readings),
                    "parameters of the other set-up": calibration.construction.points_from_readings(
                        pointings.readings, calibration.estimates[0]
                    ),
                }
                parts += [gaps(spans, names, points).assign(coordinates=f"one face, {how}")
                          for how, points in single.items()]  # fmt: skip
    both_ways = pd.DataFrame({"gap": 1e6 * np.concatenate(back)})
    parts.append(both_ways.assign(coordinates="interferometer, there less back", lines="all"))
    groups = pd.concat(parts).groupby(["coordinates", "lines"]).gap
    table = groups.agg(
        lengths="size", mean="mean", rms=lambda g: (g**2).mean() ** 0.5, median=lambda g: g.abs().median()
    )
    units = {"mean": "mean um", "rms": "rms um", "median": "median |gap| um"}
    show_table(out / "lines.csv", table.round(2).rename(columns=units).reset_index().to_dict("records"))


def gaps(spans: pd.DataFrame, names: Sequence[str], points: Floats) -> pd.DataFrame:
    """Lengths [um] between points (n, 3) [m] minus interferometer lengths, if both ends have coordinates."""
    place = dict(zip(names, points, strict=True))
    measured = spans[spans["first"].isin(place) & spans.second.isin(place)]
    lengths = [np.linalg.norm(place[b] - place[a]) for a, b in zip(measured["first"], measured.second, strict=True)]
    return measured.assign(gap=1e6 * (np.array(lengths) - measured.length))


def index(out: Path) -> None:
    """Test whether the vertical index is constant, from half face differences in elevation.

    The table has the difference between the set-ups and the drift in each set-up.
    """
    estimate, rows = noise_of_recordings(out), []
    for name in EPOCHS:
        recording = reject_outliers(epoch(name, estimate))[0]
        pairs = two_face_pairs(recording)
        station = recording.station[pairs.pointing_indices[:, 0]]
        design = [-1.0 / pairs.mean_front_face_readings[:, 0]]
        for s in (0, 1):
            is_of_station = station == s
            order = np.zeros(len(pairs))
            order[is_of_station] = np.linspace(-1.0, 1.0, int(is_of_station.sum()))
            design += [-is_of_station.astype(float), -order]
        a, y = np.array(design).T, pairs.half_differences[:, 2] * 1e6
        x, squares = np.linalg.lstsq(a, y)[:2]
        covariance = np.linalg.inv(a.T @ a) * squares[0] / (len(y) - a.shape[1])
        sigma = np.sqrt(np.diag(covariance))
        step = np.array([0.0, -1.0, 0.0, 1.0, 0.0])
        spread = np.sqrt(step @ covariance @ step)
        rows.append({"epoch": name, "index of 1 less 0 urad": f"{step @ x:.2f} +- {spread:.2f}",
                     "drift within 0 urad": f"{2 * x[2]:.2f} +- {2 * sigma[2]:.2f}",
                     "drift within 1 urad": f"{2 * x[4]:.2f} +- {2 * sigma[4]:.2f}"})  # fmt: skip
    show_table(out / "index.csv", rows)


def checks(out: Path) -> None:
    """Test three reported causes in every epoch: half differences in range, and differences from the interferometer."""
    estimate, rows = noise_of_recordings(out), []
    for name in EPOCHS:
        recording = epoch(name, estimate)
        pairs, spans = two_face_pairs(recording), interferometer(name)
        is_of_target = recording.target[pairs.pointing_indices[:, 0]] == recording.targets.index("K6")
        row = {
            "epoch": name,
            "K6 half difference in range um": round(1e6 * pairs.half_differences[is_of_target, 0].mean(), 1),
        }
        points = adjust(recording, misalignment_construction()).state.target_points
        for target in ("PQK36_3", "PQK62_10"):
            ends = spans[(spans["first"] == target) | (spans.second == target)]
            row[f"{target} less interferometer um"] = gaps(ends, recording.targets, points).gap.mean().round(1)
        rows.append(row)
    show_table(out / "checks.csv", rows)


def diagnoses(out: Path) -> None:
    """Diagnose every epoch with the default noise and with the estimated noise; half a minute for each diagnosis."""
    rows: Rows = []
    for label, noise_of_tracker in (("default", None), ("estimated", noise_of_recordings(out))):
        for name in EPOCHS:
            content = diagnose(epoch(name, noise_of_tracker)).content()
            before, after = content["fit"]["before"], content["fit"]["after"]
            rows.append({"noise": label, "epoch": name, "verdict": content["verdict"],
                         "chi2/dof": f"{before['chi2'] / before['dof']:.2f} to {after['chi2'] / after['dof']:.2f}",
                         "findings": "; ".join(finding_text(f) for f in content["findings"])})  # fmt: skip
    show_table(out / "diagnoses.csv", rows)


def finding_text(finding: dict) -> str:
    """Effect, place, parameters, probability and equivalent effects of a finding in one line."""
    where = finding["where"]
    place = " ".join([*where["stations"], *where["targets"], *where["observables"]])
    sizes = ", ".join(f"{p['name']} {p['value']:.3g} +- {p['sigma']:.2g} {p['unit']}".strip()
                      for p in finding["parameters"])  # fmt: skip
    others = ", ".join(e["effect"] for e in finding["equivalents"])
    chance = f"probability {finding['evidence']['probability']:.2f}"
    return f"{finding['effect']} {place} ({sizes}; {chance}{'; or ' + others if others else ''})".replace("  ", " ")


STEPS = {f.__name__: f for f in (noise, course, transfer, lines, index, checks, diagnoses)}


def run(options: Options) -> RunRecord:
    """Run the steps that the command line names, or all steps."""
    run_steps(options, STEPS)
    return RunRecord()
