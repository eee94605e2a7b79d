"""Make a recording with something hidden in it, and seal the truth apart from it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace, orthonormal
from ltsim.arrays import Floats
from ltsim.diagnosis.cards import card_hypotheses
from ltsim.effects import BASELINE
from ltsim.effects.effect import Effect, NoiseEffect, SlotEffect
from ltsim.effects.face_confusion import FaceConfusion
from ltsim.effects.range_step import RangeStep
from ltsim.effects.station_bump import StationBump
from ltsim.effects.target_swap import TargetSwap
from ltsim.effects.wrong_unit import WrongUnit
from ltsim.errors import LtsimError
from ltsim.geometry.alignment import align
from ltsim.model.construction import misalignment
from ltsim.model.measurement import MeasurementModel, sightings_of
from ltsim.randomness import stream
from ltsim.recording import Recording, write
from ltsim.recording.files import write_text
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings
from ltsim.units import FACTOR, MICROMETRE, MILLIMETRE

from .hidden import MISTAKES, Hidden, draw_hidden, draw_mistake, left_by_adjustment, strength, strengths
from .independent.make import make
from .invented import Invented
from .plan import Case
from .workshop import GAUGE_SIGMA, Scene, draw_scene


def conceal(case: Case, recordings: Path, sealed: Path) -> None:
    """Write the recording of a case, bare, and its truth; what is there already stays."""
    target, secret = recordings / case.name, sealed / f"{case.name}.json"
    if secret.exists() and (target / "observations.csv").exists():
        return
    if case.independent:
        recording, truth = _made_independently(case)
    else:
        recording, truth = _made(case)
    write(recording, target)
    write_text(secret, json.dumps(truth, indent=1) + "\n")


def _made_independently(case: Case) -> tuple[Recording, dict[str, Any]]:
    """A recording of the second simulator; what the catalogue explains of an unknown law is asked of ltsim."""
    draw, noise = (stream(case.seed, *case.key, what) for what in ("scene", "noise"))
    made = make(case.kind, case.strength, case.number, draw, noise, case.laws)
    truth = _plan_entry(case) | made.truth
    if case.kind == "unknown":
        space = ResidualSpace.of(adjust(made.silent, misalignment()))
        truth["nearest_known"] = _nearest_known(space, space.project(space.whiten(made.change[:, :, None])[:, 0]))
    return made.recording, truth


def _made(case: Case) -> tuple[Recording, dict[str, Any]]:
    """A recording of ltsim's own chain and effects."""
    scene = draw_scene(stream(case.seed, *case.key, "scene"))
    space = ResidualSpace.of(_silent_adjustment(scene))
    hidden = _drawn(case, space)
    recording = measured(scene, hidden, stream(case.seed, *case.key, "noise"))
    truth = {
        **_plan_entry(case),
        "effects": [_entry(h, space) for h in hidden],
        "nearest_known": _nearest_known(space, left_by_adjustment(space, hidden[0])[1])
        if case.kind == "unknown"
        else None,
        "targets_mm": dict(zip(recording.targets, (scene.state.points / MILLIMETRE).tolist(), strict=True)),
        "told_um": _told(scene, recording, hidden, stream(case.seed, *case.key, "noise")),
        "ordinary_um": _error(recording, scene, ()),
        "stations": len(recording.stations),
        "faces": int(recording.face.max()),
        "pointings": len(recording),
    }
    return recording, truth


def _plan_entry(case: Case) -> dict[str, Any]:
    return {"name": case.name, "seed": case.seed, "kind": case.kind, "strength": case.strength, "number": case.number}


def _drawn(case: Case, space: ResidualSpace) -> list[Hidden]:
    rng = stream(case.seed, *case.key, "hidden")
    match case.kind:
        case "clean":
            return []
        case "mistake":
            return [draw_mistake(space.sightings, rng)]
        case "unknown":
            return [draw_hidden(space, rng, case.strength, known=False, laws=case.laws)]
        case "single":
            return [draw_hidden(space, rng, case.strength)]
    found: list[Hidden] = []
    while len(found) < 2:
        other = draw_hidden(space, rng, case.strength)
        if all(other.effect.name != h.effect.name for h in found):
            found.append(other)
    return found


def _with_gauge(scene: Scene, lengths: Floats) -> Recording:
    setup = scene.recording.setup.model_copy(update={"gauge": scene.gauge(lengths)})
    return scene.recording.replace(setup=setup)


def _silent_adjustment(scene: Scene) -> Any:
    """The ordinary adjustment of readings without noise: what it leaves of an effect is exact."""
    recording = _with_gauge(scene, scene.lengths)
    readings = MeasurementModel(recording, misalignment()).predict(scene.state)
    return adjust(recording.with_readings(readings), misalignment(), start=scene.state)


def measured(scene: Scene, hidden: Sequence[Hidden], rng: np.random.Generator) -> Recording:
    """The recording: exact chain with all errors of the axes, effects in the order of the light's way, noise.

    Blunders are made by doing the wrong thing, not by adding its consequence: another target or face is measured, and
    finished readings are written down in another unit.
    """
    in_chain = [h for h in hidden if isinstance(h.effect, SlotEffect)]
    slots = [h.effect for h in in_chain if isinstance(h.effect, SlotEffect)]
    construction = misalignment([*BASELINE, *slots])
    instrument = np.concatenate([scene.state.instrument[0], *(h.values for h in in_chain)])
    sightings = sightings_of(_as_done(scene, hidden), scene.state)
    readings = construction.readings(sightings.local, sightings.face, instrument)
    lengths = scene.lengths.copy()
    added = [h for h in hidden if not isinstance(h.effect, (SlotEffect, *MISTAKES))]
    for h in sorted(added, key=lambda h: h.effect.stage):
        readings = readings + h.shift(sightings)
        lengths = lengths + h.effect.gauge_design(scene.first, scene.second, scene.state.points) @ h.values
    readings = readings + true_sigma(scene, hidden) * rng.standard_normal(readings.shape)
    lengths = lengths + GAUGE_SIGMA * MILLIMETRE * rng.standard_normal(len(lengths))
    return _with_gauge(scene, lengths).with_readings(_as_written(readings, sightings, hidden))


def _as_done(scene: Scene, hidden: Sequence[Hidden]) -> Recording:
    """The pointings that were made, where the rows say otherwise: reflectors exchanged, faces confused."""
    recording = scene.recording
    for h in hidden:
        acts = h.effect.mask(sightings_of(scene.recording, scene.state)) > 0
        if isinstance(h.effect, TargetSwap):
            a, b = (recording.targets.index(name) for name in h.effect.targets)
            other = np.where(recording.target == a, b, a)
            recording = recording.replace(target=np.where(acts, other, recording.target))
        if isinstance(h.effect, FaceConfusion):
            wrong = acts & (recording.face == h.effect.face)
            recording = recording.replace(face=np.where(wrong, 3 - recording.face, recording.face))
    return recording


def _as_written(readings: Floats, sightings: Sightings, hidden: Sequence[Hidden]) -> Floats:
    """The readings as they were written down, some perhaps in another unit."""
    written = readings.copy()
    for h in hidden:
        if isinstance(h.effect, WrongUnit):
            rows = h.effect.mask(sightings) > 0
            written[rows] = h.effect.slip.written(written[rows])
    return written


def true_sigma(scene: Scene, hidden: Sequence[Hidden]) -> Floats:
    """True standard deviation (n, 3) of the readings."""
    sightings = sightings_of(scene.recording, scene.state)
    sigma = scene.recording.with_readings(sightings.raw).sigma()
    for h in hidden:
        if isinstance(h.effect, NoiseEffect):
            sigma = np.sqrt(h.effect.variance(sightings, sigma, h.values))
    return sigma


def _told(scene: Scene, recording: Recording, hidden: Sequence[Hidden], rng: np.random.Generator) -> float:
    """Error [um] of the targets when the adjustment is told the truth: which effect, where, with which shape.

    Its size is estimated. A blunder is taken back instead.
    """
    blunders = [h for h in hidden if not _is_fitted(h)]
    if blunders:
        recording = measured(scene, [h for h in hidden if h not in blunders], rng)
    effects = [h.effect for h in hidden if _is_fitted(h) and not isinstance(h.effect, NoiseEffect)]
    return _error(recording, scene, effects, true_sigma(scene, hidden))


def _is_fitted(hidden: Hidden) -> bool:
    return bool(hidden.effect.parameters[0].unit) or isinstance(hidden.effect, NoiseEffect)


def _error(recording: Recording, scene: Scene, effects: Sequence[Effect], sigma: Floats | None = None) -> float:
    """Root mean square error [um] of the adjusted targets after the best rigid fit to the truth."""
    start = replace(scene.state, extra=np.zeros(sum(len(e.parameters) for e in effects)))
    try:
        points = adjust(recording, misalignment(), effects=tuple(effects), sigma=sigma, start=start).state.points
    except (LtsimError, np.linalg.LinAlgError):
        return float("nan")
    return rigid_error(points, scene.state.points)


def rigid_error(points: Floats, truth: Floats) -> float:
    """Root mean square distance [um] of points (T, 3) [m] from the truth after the best rigid fit."""
    rotation, translation = align(points, truth)
    gap = points @ rotation.T + translation - truth
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))) / MICROMETRE)


def _nearest_known(space: ResidualSpace, left: Floats) -> dict[str, Any]:
    """The effect of the catalogue that explains most of what is left (m,) of an invented one, and the share."""
    best, share = "", 0.0
    if not left.any():  # noise shifts no reading
        return {"effect": best, "share": share}
    for effect in card_hypotheses(space.sightings):
        signature = space.signature(effect)
        norms = np.linalg.norm(signature, axis=0)
        columns = orthonormal(space.project(signature), norms) if norms.any() else signature[:, :0]
        explained = float(((columns.T @ left) ** 2).sum()) / float(left @ left)
        if explained > share:
            best, share = effect.name, explained
    return {"effect": best, "share": share}


def _entry(hidden: Hidden, space: ResidualSpace) -> dict[str, Any]:
    effect = hidden.effect
    seen = () if set(effect.observables) == set(OBSERVABLES) else effect.observables
    felt = {} if getattr(effect, "law", "exponential") != "exponential" else _constants(effect)
    return {
        "effect": effect.name,
        "text": repr(effect),
        "stations": list(effect.stations),
        "targets": list(effect.targets),
        "observables": list(seen),
        "covariates": list(effect.covariates),
        "parameters": [
            {"name": p.name, "value": float(v) / p.factor, "unit": p.unit}
            for p, v in zip(effect.parameters, hidden.values, strict=True)
        ],
        "shape": felt,
        "size": hidden.size,
        "strength": strength(space, hidden),
        "strengths": strengths(space, hidden).tolist(),
        "words": effect.words if isinstance(effect, Invented) else {},
    }


def _constants(effect: Effect) -> dict[str, float]:
    """Continuous shape constants, and the time of a change, in the unit a person reads them in."""
    changes = isinstance(effect, RangeStep | StationBump) or getattr(effect, "kind", "") == "step"
    when = {"time": float(effect.time)} if changes and hasattr(effect, "time") else {}
    return when | {s.name: float(getattr(effect, s.name)) / FACTOR[s.unit] for s in type(effect).shape}
