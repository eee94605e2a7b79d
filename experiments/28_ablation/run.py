"""What does each part of the searched space give? Power of the search without it, beside the plain chi-square test."""

import json
from importlib import import_module

import numpy as np
import pandas as pd

import ltsim as lt
from experiments.common import ROOT, Made, Options, Row, write_figure, write_table
from experiments.intervals import share
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
WHOLE, CHI2, CARDS, NOISE = "the whole search", "chi-square alone", "cards", "noise"
Part = tuple[str, str]
Scored = tuple[float, Floats]


def part_of(driver: Regressor) -> str:
    """A driver's operator, or how it is made of others; what has neither is a curve, a wave or a formula."""
    if driver.kind == "product":
        return "across the room" if any(f.kind == "field" for f in driver.factors) else "product"
    memory = any(name_without_memory_prefix(name) != name or name == "lapse" for name in driver.covariates)
    return "memory" if memory and driver.kind != "lagging" else driver.kind


def parts_of(space: ResidualSpace) -> dict[Part, list[Scored]]:
    """Log evidence of each part of the searched space, in the recording and in simulated ones (trials,)."""
    sightings, instruments = space.sightings, space.adjustment.recording.instruments
    probe = NullEnsemble.from_residual_space(space, 0, MIN_SIMULATED_RECORDINGS)
    bank = NoiseHypothesisSet.from_residual_space(space, noise_hypotheses(sightings, instruments))
    cards = CatalogueDesigns.from_residual_space(space, catalogue_candidate_effects(sightings, instruments))
    values, chance, _ = cards.screen(probe)
    own = np.append(bank.log_evidence_by_family(space.whitened_residuals[:, None], space.redundancy)[:, 0], -np.inf)
    drawn = bank.log_evidence_by_family(probe.simulated_residuals, space.redundancy)
    share, families = (
        log_prior_of_each_explanation("named", len(cards.family_names)),
        cards.log_evidence_by_family(values),
    )
    found = {(CARDS, CARDS): [(float(log_sum_exp(families + share)), log_sum_exp(chance + share))],
             (NOISE, NOISE): [(float(log_sum_exp(own)), log_sum_exp(drawn))]}  # fmt: skip
    for panel in law_batches(space):
        part = panel.responses[0].changed_part, part_of(panel.regressors[0])
        found.setdefault(part, []).append(panel.best_laws_and_log_total_evidence(probe)[1:])
    return found


def p_value(parts: list[Scored]) -> float:
    """Chance of as much evidence in a clean recording: its rank among simulated ones."""
    own, null = log_sum_exp(np.array([one for one, _ in parts])), log_sum_exp(np.stack([n for _, n in parts]))
    return float((np.sum(null >= own) + 1) / (len(null) + 1))


def chances(name: str) -> dict[str, float]:
    """The p-value of the search, whole and without each part, and of chi-square alone."""
    recording = lt.read(WORK / make.RECORDINGS / name)
    adjusted = adjust(recording, declared_construction(recording))
    parts = parts_of(ResidualSpace.from_adjustment(adjusted))
    told = {CHI2: adjusted.p_value, WHOLE: p_value([s for some in parts.values() for s in some])}
    for what, kept in {"without laws": (CARDS, NOISE), "curves of readings alone": ("reading",)}.items():
        alone = [s for (carrier, driver), some in parts.items() if carrier in kept for s in some
                 if carrier != "reading" or driver == "smooth"]  # fmt: skip
        told[what] = p_value(alone)
    for at, words in ((0, "carrier"), (1, "driver")):
        for dropped in sorted({part[at] for part in parts}):
            what = dropped if dropped in (CARDS, NOISE) else f"{words} {dropped}"
            told[f"without {what}"] = p_value([s for k, some in parts.items() if k[at] != dropped for s in some])
    return told


def run(given: Options) -> Made:
    """All, or with the word `tables` the figure of the committed rows."""
    cases, file, more = make.read_plan(given.here / "plan.toml"), given.out / "power.csv", {}
    if "tables" not in given.words:
        more = {"truth_sha256": make.make(cases, WORK, given.jobs)}
        truth = json.loads((WORK / make.TRUTH).read_text(encoding="utf-8"))
        told = list(run_parallel(chances, [(name,) for name in truth], given.jobs))
        rows: list[Row] = []
        for what in dict.fromkeys(key for one in told for key in one):
            for strength in sorted({t["strength"] for t in truth.values()}):
                some = [(one.get(what, one[WHOLE]) <= LEVEL, t["law"] or t["name"])
                        for one, t in zip(told, truth.values(), strict=True) if t["strength"] == strength]  # fmt: skip
                rows.append({"search": what, "strength": strength} | share(*zip(*some, strict=True)))
        write_table(file, rows)
    table = pd.read_csv(file).query("strength > 0").groupby("search")
    least = table["share"].sum().drop([WHOLE, CHI2]).nsmallest(3)
    lines = [SweepPoint(str(r["strength"]), what, "", *(100 * r[k] for k in ("share", "low", "high", "share", "share")))
             for what in (WHOLE, CHI2, *least.index) for r in table.get_group(what).to_dict("records")]  # fmt: skip
    axis = "strength: noncentrality left by least squares"
    figure = sweep_panels_figure(lines, statistic_title="laws found at 5 % false alarms [%]", x_title=axis)
    write_figure(given.out / "power.svg", figure)
    return Made(cases[0].seed, more=more)
