"""Contribution of each part of the search space: power of the search without it, and of the chi-square test."""

import json
from importlib import import_module

import numpy as np
import pandas as pd

import ltsim as lt
from experiments.common import ROOT, Options, Row, RunRecord, write_figure, write_table
from experiments.intervals import proportion
from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.core.parallel import run_parallel
from ltsim.diagnosis.catalogue_designs import CatalogueDesigns, catalogue_candidate_effects
from ltsim.diagnosis.law_search_space import law_batches
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.null_ensemble import MIN_SIMULATED_RECORDINGS, NullEnsemble
from ltsim.diagnosis.prior import log_prior_of_each_explanation
from ltsim.physics.laws.regressors import Regressor, name_without_memory_prefix
from ltsim.physics.model.construction import declared_construction
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure

make = import_module("experiments.20_concealed_physics.make")
WORK, LEVEL = ROOT / "build" / "ablation", 0.05
COMPLETE_SEARCH, CHI2, CATALOGUE, NOISE = "complete search", "chi-square test", "catalogue", "noise"
Part = tuple[str, str]
Scored = tuple[float, Floats]


def part_of(driver: Regressor) -> str:
    """Operator or construction of a regressor; without these, its kind (curve, wave or formula)."""
    if driver.kind == "product":
        return "across the room" if any(f.kind == "field" for f in driver.factors) else "product"
    memory = any(name_without_memory_prefix(name) != name or name == "lapse" for name in driver.covariates)
    return "memory" if memory and driver.kind != "lagging" else driver.kind


def parts_of(space: ResidualSpace) -> dict[Part, list[Scored]]:
    """Log evidence of each part of the search space, for the recording and for simulated recordings (trials,)."""
    sightings, instruments = space.sightings, space.adjustment.recording.instruments
    probe = NullEnsemble.from_residual_space(space, 0, MIN_SIMULATED_RECORDINGS)
    bank = NoiseHypothesisSet.from_residual_space(space, noise_hypotheses(sightings, instruments))
    cards = CatalogueDesigns.from_residual_space(space, catalogue_candidate_effects(sightings, instruments))
    values, chance, _ = cards.screen(probe)
    log_evidences = np.append(
        bank.log_evidence_by_family(space.whitened_residuals[:, None], space.redundancy)[:, 0], -np.inf
    )
    drawn = bank.log_evidence_by_family(probe.simulated_residuals, space.redundancy)
    share, families = (
        log_prior_of_each_explanation("named", len(cards.family_names)),
        cards.log_evidence_by_family(values),
    )
    scored_parts = {(CATALOGUE, CATALOGUE): [(float(log_sum_exp(families + share)), log_sum_exp(chance + share))],
             (NOISE, NOISE): [(float(log_sum_exp(log_evidences)), log_sum_exp(drawn))]}  # fmt: skip
    for panel in law_batches(space):
        part = panel.responses[0].changed_part, part_of(panel.regressors[0])
        scored_parts.setdefault(part, []).append(panel.best_laws_and_log_total_evidence(probe)[1:])
    return scored_parts


def p_value(parts: list[Scored]) -> float:
    """p-value of the evidence: its rank among recordings that are simulated without an effect."""
    actual, null = (
        log_sum_exp(np.array([actual_value for actual_value, _ in parts])),
        log_sum_exp(np.stack([n for _, n in parts])),
    )
    return float((np.sum(null >= actual) + 1) / (len(null) + 1))


def p_values_of(name: str) -> dict[str, float]:
    """p-values of the complete search, of the search without each part, and of the chi-square test."""
    recording = lt.read(WORK / make.RECORDINGS / name)
    adjusted = adjust(recording, declared_construction(recording))
    parts = parts_of(ResidualSpace.from_adjustment(adjusted))
    p_values = {CHI2: adjusted.p_value, COMPLETE_SEARCH: p_value([s for scores in parts.values() for s in scores])}
    for search, parts_of_search in {
        "without laws": (CATALOGUE, NOISE),
        "curves of readings alone": ("reading",),
    }.items():
        alone = [s for (carrier, driver), scores in parts.items() if carrier in parts_of_search for s in scores
                 if carrier != "reading" or driver == "smooth"]  # fmt: skip
        p_values[search] = p_value(alone)
    for position, role in ((0, "carrier"), (1, "driver")):
        for dropped in sorted({part[position] for part in parts}):
            part_name = dropped if dropped in (CATALOGUE, NOISE) else f"{role} {dropped}"
            p_values[f"without {part_name}"] = p_value(
                [s for k, scores in parts.items() if k[position] != dropped for s in scores]
            )
    return p_values


def run(options: Options) -> RunRecord:
    """Run the ablation and draw its figure; the argument `tables` only draws the figure of the committed rows."""
    cases, file, entries = make.read_plan(options.folder / "plan.toml"), options.out / "power.csv", {}
    if "tables" not in options.arguments:
        entries = {"truth_sha256": make.make(cases, WORK, options.jobs)}
        truth = json.loads((WORK / make.TRUTH).read_text(encoding="utf-8"))
        all_p_values = list(run_parallel(p_values_of, [(name,) for name in truth], options.jobs))
        rows: list[Row] = []
        for search in dict.fromkeys(key for p_values in all_p_values for key in p_values):
            for strength in sorted({t["strength"] for t in truth.values()}):
                detections = [
                    (p_values.get(search, p_values[COMPLETE_SEARCH]) <= LEVEL, t["law"] or t["name"])
                    for p_values, t in zip(all_p_values, truth.values(), strict=True)
                    if t["strength"] == strength
                ]
                rows.append({"search": search, "strength": strength} | proportion(*zip(*detections, strict=True)))
        write_table(file, rows)
    table = pd.read_csv(file).query("strength > 0").groupby("search")
    least = table["proportion"].sum().drop([COMPLETE_SEARCH, CHI2]).nsmallest(3)
    ends = ("proportion", "low", "high", "proportion", "proportion")
    lines = [
        SweepPoint(str(r["strength"]), search, "", *(100 * r[k] for k in ends))
        for search in (COMPLETE_SEARCH, CHI2, *least.index)
        for r in table.get_group(search).to_dict("records")
    ]
    axis = "noncentrality after the adjustment"
    figure = sweep_panels_figure(lines, statistic_title="laws detected at 5 % false alarms [%]", x_title=axis)
    write_figure(options.out / "power.svg", figure)
    return RunRecord(cases[0].seed, entries=entries)
