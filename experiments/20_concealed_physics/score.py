"""Score of one answer against the truth of its recording; RULES.md describes the rules."""

import csv
import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .law import OBSERVABLES
from .make import Case, draw_case
from .measure import Model

Row = dict[str, Any]
LIMIT = 1.959964
MIN_SHOWN_FRACTION = 0.1
"""Fraction of the strength above which an observable belongs to the observables of a law."""
OVERLAP = 0.5
"""Fraction of common names from which several stations or targets count as correct."""
RIGHT = 0.75
"""Fraction of the true signal from which a model counts as correct; a model of half the true size explains 0.75."""
HIGH = 0.9
GEOMETRY = {"distance", "azimuth", "elevation", "incidence", "height", "place", "face"}
"""Covariates of the pointing itself, which need not be reported for an instrument constant or a motion."""
COVARIATE_SYNONYMS = {"hall_temperature_c": "temperature"}
AS_UNKNOWN = {"noise": ("noise-level", "station-noise", "turbulence"), "gauge": ("gauge-scale", "gauge-shape")}
"""Names of catalogue effects that are correct for a law with this response, in addition to `unknown`."""
WORDS = {
    "station": ("stand", "station"),
    "targets": ("target", "nest"),
    "gauge": ("gauge", "length"),
    "noise": ("noise",),
}
"""Words that report a response, in addition to the names of the tracker's constants."""


def score_recording(truth: dict[str, Any], folder: Path) -> Row:
    """Row of the scores of one recording."""
    row: Row = {k: truth[k] for k in ("name", "kind", "hall", "law", "strength", "plain_um")}
    row["given_law_um"] = truth["told_um"]
    status = json.loads((folder / "status.json").read_text(encoding="utf-8"))
    row |= {"seconds": status["seconds"], "answered": (folder / "diagnosis.json").is_file()}
    if not row["answered"]:
        return row
    answer = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    findings, test, hidden = answer["findings"], answer["global_test"], truth["hidden"]
    row |= {"detected": answer["verdict"] == "mismatch", "p_value": test.get("search_p_value", test["p_value"])}
    row |= {"answer": " + ".join(f["effect"] for f in findings), "single_finding": len(findings) == 1}
    row["error_um"] = target_error(truth["targets_mm"], folder / "targets.csv")
    probabilities = [(f.get("evidence", {}).get("probability"), f) for f in findings]
    row["probabilities"] = [(p, right(truth, f)) for p, f in probabilities if p is not None]
    first = findings[0] if findings else None
    if truth["kind"] == "catalogued":
        row |= _name_scores(truth, first)
    if truth["kind"] == "unknown":
        row |= _law_scores(hidden, first)
    if truth["kind"] != "clean":
        row |= _model_scores(truth, first, folder)
    return row


def _model_scores(truth: dict[str, Any], finding: dict[str, Any] | None, folder: Path) -> Row:
    """Explained fraction of the true signal, correctness of the report, coefficients over those of the truth."""
    _, network, _, change = draw_case(Case.of(truth), Counter())
    model, hidden, noise = Model.read(folder, network), truth["hidden"], change.variance is not None
    row: Row = {"explained_fraction": model.explained_fraction(network, change), "correctly_reported": False}
    if "law" in model.notes:
        row["law_right"] = model.notes["law"] == truth["law"]
    if finding is None:
        return row
    row["place_right"] = place_right(truth, finding)
    row["observable_shown"] = (
        set(hidden.get("observables", ())) == set(finding["where"].get("observables", ())) != set()
        or observable_right(hidden, finding)
        or (
            "gauge" not in hidden["carriers"]
            and model.observables(network, MIN_SHOWN_FRACTION, noise=noise) == _observables_of_law(hidden)
        )
    )
    row["correctly_reported"] = row["explained_fraction"] >= RIGHT and row["place_right"] and row["observable_shown"]
    if model.notes.get("coefficients"):
        row["coefficients"] = model.notes["coefficients"] / hidden["coefficients"]
    return row


def place_right(truth: dict[str, Any], finding: dict[str, Any]) -> bool:
    """True for the stations, targets and instruments of an effect, or the stations and instruments of a law."""
    keys = ("stations", "targets") if truth["kind"] == "catalogued" else ("stations", "instruments")
    pairs = [(set(truth["hidden"][key]), set(finding["where"].get(key, []))) for key in keys]
    several = truth["kind"] == "unknown"
    return all(_names_agree(true, reported) or (several and len(true) > 1 and not reported) for true, reported in pairs)


def right(truth: dict[str, Any], finding: dict[str, Any]) -> bool:
    """True if a finding has name and place of the effect, or is unknown with the observable of the law."""
    if truth["kind"] == "clean":
        return False
    if truth["kind"] == "catalogued":
        return finding["effect"] == truth["law"] and same_place(truth["hidden"], finding, strict=True)
    return is_unknown(truth["hidden"], finding) and observable_right(truth["hidden"], finding)


def target_error(true_mm: dict[str, list[float]], file: Path) -> float | None:
    """Root mean square error [um] of the targets after the best rigid fit; None without targets."""
    if not file.is_file():
        return None
    with file.open(encoding="utf-8") as lines:
        reported = {r["target"]: [float(r[f"{a}_mm"]) for a in "xyz"] for r in csv.DictReader(lines)}
    names = [name for name in true_mm if name in reported]
    if len(names) < 4:
        return None
    points, truth = (np.array([source[n] for n in names]) for source in (reported, true_mm))
    a, b = points - points.mean(axis=0), truth - truth.mean(axis=0)
    gap = Rotation.align_vectors(b, a)[0].apply(a) - b
    return float(1e3 * np.sqrt((gap**2).sum(axis=1).mean()))


def _name_scores(truth: dict[str, Any], finding: dict[str, Any] | None) -> Row:
    """Scores of the name, the place and the parameters of an effect in the first finding."""
    if finding is None:
        return {"named_first": False, "named": False}
    first = finding["effect"] == truth["law"]
    is_alternative = any(e["effect"] == truth["law"] for e in finding.get("equivalents", [])[:3])
    row: Row = {"named_first": first, "named": first or is_alternative}
    if row["named"]:
        row["place"] = same_place(truth["hidden"], finding, strict=first)
    if first:
        true = {p["name"]: p["value"] for p in truth["hidden"]["parameters"]} | truth["hidden"]["shape"]
        reported = [p for p in finding.get("parameters", []) if p["name"] in true and p["sigma"] > 0]
        row["parameters"] = [bool(abs(p["value"] - true[p["name"]]) <= LIMIT * p["sigma"]) for p in reported]
    return row


def same_place(hidden: dict[str, Any], finding: dict[str, Any], *, strict: bool) -> bool:
    """True if stations, targets and observables agree; an alternative effect may be less confined."""
    true = {key: set(hidden[key]) for key in ("stations", "targets", "observables")}
    reported = {key: set(finding["where"].get(key, [])) for key in true}
    sets = [(true[key], reported[key]) for key in ("stations", "targets")]
    loose = not strict and (not true["observables"] or not reported["observables"])
    observables = loose or reported["observables"] == true["observables"]
    return observables and all(_names_agree(a, b) or (not strict and (not a or not b)) for a, b in sets)


def _names_agree(true: set[str], reported: set[str]) -> bool:
    return true == reported if len(true) < 2 else len(true & reported) >= OVERLAP * len(true | reported)


def _law_scores(hidden: dict[str, Any], finding: dict[str, Any] | None) -> Row:
    """Scores of a law that is reported as unknown: observable, place and covariates."""
    scores = ("unknown", "observable", "all_covariates", "outside", "covariates_or_outside", "place", "wrong_name")
    if finding is None:
        return dict.fromkeys(scores, False)
    unknown = is_unknown(hidden, finding)
    observable = unknown and observable_right(hidden, finding)
    outside = observable and (finding.get("outside", False) or not _covariates(finding))
    covariates = observable and not finding.get("outside", False) and covariates_right(hidden, finding)
    wrong = not unknown and finding.get("evidence", {}).get("probability", 0.0) > HIGH
    place = unknown and place_right({"kind": "unknown", "hidden": hidden}, finding)
    values = (unknown, observable, covariates, outside and not covariates, covariates or outside, place, wrong)
    response_and_regressor = {
        f"reported_{name}": finding.get(key, "") for name, key in (("response", "carrier"), ("regressor", "driver"))
    }
    return response_and_regressor | dict(zip(scores, values, strict=True))


def is_unknown(hidden: dict[str, Any], finding: dict[str, Any]) -> bool:
    """True if reported as unknown; a law of the noise or of the gauge may have the general name."""
    return finding["effect"] in {"unknown", *(n for c in hidden["carriers"] for n in AS_UNKNOWN.get(c, ()))}


def observable_right(hidden: dict[str, Any], finding: dict[str, Any]) -> bool:
    """True if the observables in which the law shows are reported, or the constant or motion that the law changes."""
    tokens = set(re.findall(r"[a-z]+", finding.get("carrier", "").lower()))
    tokens |= {token.rstrip("s") for token in tokens}
    for carrier in hidden["carriers"]:
        if carrier in WORDS and (tokens & set(WORDS[carrier]) or finding["effect"] in AS_UNKNOWN.get(carrier, ())):
            return carrier != "noise" or _reported_observables(finding) == _observables_of_law(hidden)
        if carrier not in OBSERVABLES and not (set(carrier.split("-")) - {"cos", "sin"}) - tokens:
            return True
    return "gauge" not in hidden["carriers"] and _reported_observables(finding) == _observables_of_law(hidden)


def _observables_of_law(hidden: dict[str, Any]) -> set[str]:
    """Observables in which a law shows, by their part of its strength."""
    parts = hidden["strengths"][:3]
    return {
        name
        for name, part in zip(OBSERVABLES, parts, strict=True)
        if part > MIN_SHOWN_FRACTION * sum(hidden["strengths"])
    }


def _reported_observables(finding: dict[str, Any]) -> set[str]:
    """Observables of a finding, all if it names none; for noise those whose factor exceeds its uncertainty."""
    parameters = finding.get("parameters", [])
    scatter = {p["name"].removeprefix("noise-") for p in parameters if p["value"] > LIMIT * p["sigma"]} & set(
        OBSERVABLES
    )
    return set(finding["where"].get("observables", [])) or scatter or set(OBSERVABLES)


def _covariates(finding: dict[str, Any]) -> set[str]:
    return {COVARIATE_SYNONYMS.get(name, name) for name in finding["where"].get("covariates", [])}


def covariates_right(hidden: dict[str, Any], finding: dict[str, Any]) -> bool:
    """True if each covariate of the law is reported, and no other than the permitted ones."""
    reported, follows = (
        _covariates(finding),
        [{COVARIATE_SYNONYMS.get(x, x) for x in item} for item in hidden["follows"]],
    )
    moving = any(c not in (*OBSERVABLES, "noise") for c in hidden["carriers"])
    carried = finding.get("carrier", "") not in ("", "noise", *OBSERVABLES)
    needed = [item for item in follows if not (carried and item <= GEOMETRY and len(follows) > 1)]
    allowed = set().union(*follows, hidden["may"], GEOMETRY if moving and not carried else ())
    return all(reported & item for item in needed) and reported <= {COVARIATE_SYNONYMS.get(x, x) for x in allowed}
