"""The examination with concealed physics: fair draws, nothing told, honest counting."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.effects import CATALOGUE
from ltsim.effects.effect import NoiseEffect
from ltsim.geometry.rotations import from_rotation_vector
from ltsim.laws.names import INVENTED, RESEMBLED
from ltsim.model.construction import misalignment
from ltsim.model.measurement import sightings_of
from ltsim.randomness import stream
from ltsim.recording import read

_conceal, _hidden, _invented, _plan, _score, _tables, _workshop = (
    import_module(f"experiments.20_concealed_physics.concealed.{name}")
    for name in ("conceal", "hidden", "invented", "plan", "score", "tables", "workshop")
)
conceal, measured, rigid_error = _conceal.conceal, _conceal.measured, _conceal.rigid_error
Hidden, draw_effect, draw_hidden, strength = _hidden.Hidden, _hidden.draw_effect, _hidden.draw_hidden, _hidden.strength
ALL, Invented, SETS, draw_invented = _invented.ALL, _invented.Invented, _invented.SETS, _invented.draw_invented
Case, read_plan = _plan.Case, _plan.read_plan
_coverage, _named, _pair, score = _score._coverage, _score._named, _score._pair, _score.score
rate = _tables.rate
draw_scene = _workshop.draw_scene


def case(kind: str, strength: int, number: int) -> Any:
    return Case(3, kind, strength, number)  # type: ignore[arg-type]


def space_of(made: Any, scene: Any) -> ResidualSpace:
    quiet = measured(scene, made, _Silence())  # type: ignore[arg-type]
    return ResidualSpace.of(adjust(quiet, misalignment(), start=scene.state))


class _Silence:
    """A generator without noise."""

    @staticmethod
    def standard_normal(shape: Any) -> Any:
        return np.zeros(shape)


@pytest.mark.parametrize("plan", ["quick", "full"])
def test_plans_hold_recordings_whose_names_tell_nothing(root: Path, plan: str) -> None:
    cases = read_plan(root / "experiments" / "20_concealed_physics" / f"{plan}.toml")
    assert len({c.name for c in cases}) == len(cases)
    assert [c.kind for c in cases] != sorted(c.kind for c in cases)
    assert not any(c.kind in c.name or str(c.strength) == c.name[1:] for c in cases)
    if plan == "full":
        assert sum(c.kind == "clean" for c in cases) >= 400


def test_a_recording_does_not_depend_on_when_or_where_it_is_made(tmp_path: Path) -> None:
    one, other = case("single", 200, 1), case("clean", 0, 4)
    for folder, order in (("a", (one, other)), ("b", (other, one))):
        for c in order:
            conceal(c, tmp_path / folder / "recordings", tmp_path / folder / "sealed")
    files = ("recordings/{}/observations.csv", "recordings/{}/setup.toml", "sealed/{}.json")
    for c in (one, other):
        for part in (file.format(c.name) for file in files):
            assert (tmp_path / "a" / part).read_bytes() == (tmp_path / "b" / part).read_bytes()


def test_the_folder_of_a_recording_holds_readings_and_set_up_and_no_word_of_an_effect(tmp_path: Path) -> None:
    hidden = case("single", 600, 2)
    conceal(hidden, tmp_path / "recordings", tmp_path / "sealed")
    folder = tmp_path / "recordings" / hidden.name
    assert sorted(p.name for p in folder.iterdir()) == ["observations.csv", "setup.toml"]
    text = "".join(p.read_text(encoding="utf-8") for p in folder.iterdir())
    assert not [kind.name for kind in CATALOGUE if kind.name in text]
    truth = json.loads((tmp_path / "sealed" / f"{hidden.name}.json").read_text(encoding="utf-8"))
    assert truth["effects"][0]["effect"] in {kind.name for kind in CATALOGUE}


@pytest.mark.parametrize(
    ("kind", "laws"),
    [("single", None), ("unknown", "first"), ("unknown", "later"), ("unknown", "latest"), ("unknown", "last")],
)
@pytest.mark.parametrize("number", range(4))
def test_the_strength_is_the_drop_of_chi_square_that_the_truth_brings(kind: str, laws: Any, number: int) -> None:
    """Without noise the ordinary adjustment's chi2 is the noncentrality, and told the truth it is nothing."""
    rng = stream(8, kind, number)
    scene = draw_scene(rng)
    empty = space_of([], scene)
    # The exact instrument's own prior is all that a silent recording leaves.
    assert empty.residual @ empty.residual < 40.0
    hidden = draw_hidden(empty, rng, 200.0, known=laws is None, laws=laws or "all")
    if isinstance(hidden.effect, NoiseEffect):
        pytest.skip("a change of the noise has no mean")
    filled = space_of([hidden], scene)
    left = filled.residual - empty.residual
    assert left @ left == pytest.approx(200.0, rel=0.1)
    assert hidden.size <= 20.0


def test_drawn_shapes_lie_between_the_points_of_the_search() -> None:
    rng = stream(9, "shapes")
    scene = draw_scene(rng)
    sightings = space_of([], scene).sightings
    drawn = [effect for effect in (draw_effect(sightings, rng) for _ in range(300)) if effect is not None]
    assert len({effect.name for effect in drawn}) > 20
    constants = [e.wavelength for e in drawn if e.name == "range-cyclic"]  # type: ignore[attr-defined]
    tried = [e.wavelength for e in next(k for k in CATALOGUE if k.name == "range-cyclic").candidates(sightings)]  # type: ignore[attr-defined]
    assert constants
    assert not set(constants) & set(tried)
    assert all(min(tried) <= c <= max(tried) for c in constants)


@pytest.mark.parametrize("laws", ["first", "later", "latest", "last", "newest"])
def test_no_invented_law_is_in_the_catalogue_and_each_acts_where_it_says(laws: Any) -> None:
    scene = draw_scene(stream(2, "laws"))
    sightings = space_of([], scene).sightings
    assert not set(SETS[laws]) & {kind.name for kind in CATALOGUE}
    acting = 0
    for law in SETS[laws]:
        design = Invented((), (), law, (0.3, 0.4, 0.2, 0.6, 0.9)).design(sightings)[:, :, 0]
        acting += bool(design.any())
        observable = ALL[law][0]
        if observable != "place":
            column = ("distance", "azimuth", "elevation").index(observable)
            assert not np.delete(design, column, axis=1).any()
    assert acting >= 8


@pytest.mark.parametrize(
    ("laws", "count"), [("first", 16), ("later", 16), ("latest", 20), ("last", 20), ("newest", 24)]
)
def test_every_invented_law_of_a_set_is_drawn_and_seen(laws: Any, count: int) -> None:
    """Some need a column, two faces or fixed reflectors, so that one workshop does not serve them all."""
    missing = set(SETS[laws])
    assert len(missing) == count
    for number in range(40):
        scene = draw_scene(stream(5, "sets", number))
        sightings, rng = sightings_of(scene.recording, scene.state), stream(5, "drawn", number)
        drawn = [draw_invented(sightings, rng, laws) for _ in range(150)]
        assert {effect.law for effect in drawn} <= set(SETS[laws])
        designs = [effect.design(sightings) for effect in drawn]
        assert all(np.isfinite(design).all() for design in designs)
        new = {effect.law: effect for effect, design in zip(drawn, designs, strict=True) if design.any()}
        if missing & set(new):
            space = space_of([], scene)
            seen = {law for law, effect in new.items() if strength(space, Hidden(effect, np.array([1e-5]))) > 0.0}
            missing -= seen
        if not missing:
            return
    raise AssertionError(f"never seen: {missing}")


def test_the_set_of_laws_changes_what_is_drawn_and_no_name(root: Path, tmp_path: Path) -> None:
    folder = root / "experiments" / "20_concealed_physics"
    chosen = {
        name: {c.laws for c in read_plan(folder / f"{name}.toml")} for name in ("quick", "seventh", "tenth", "full")
    }
    assert chosen == {"quick": {"first"}, "seventh": {"last"}, "tenth": {"newest"}, "full": {"later"}}
    one, other = Case(3, "unknown", 200, 1, "first"), Case(3, "unknown", 200, 1, "later")
    assert (one.name, one.key) == (other.name, other.key)
    scene = draw_scene(stream(6, "sets"))
    sightings = sightings_of(scene.recording, scene.state)
    each = [*SETS["first"], *SETS["later"], *SETS["latest"], *SETS["last"]]
    assert set(SETS["all"]) == set(each)
    apart = [*each, *SETS["newest"], *SETS["motions"]]
    assert len(set(apart)) == len(apart) == len(ALL)
    assert {draw_invented(sightings, stream(6, n), "first").law in SETS["first"] for n in range(30)} == {True}
    plan = tmp_path / "plan.toml"
    plan.write_text('seed = 1\nlaws = "none"\n', encoding="utf-8")
    with pytest.raises(SystemExit, match="not one of"):
        read_plan(plan)
    plan.write_text('seed = 1\nlaws = "latest"\n[unknown]\n200 = 2\n', encoding="utf-8")
    assert {c.laws for c in read_plan(plan)} == {"latest"}


def finding(effect: str, **changes: Any) -> dict[str, Any]:
    where = {"observables": ["distance"], "stations": ["S2"], "targets": [], "covariates": ["time"]}
    base = {"effect": effect, "known": effect != "unknown", "where": where, "equivalents": []}
    parameters = [{"name": "range-step", "value": 10.0, "sigma": 1.0, "unit": "um"}]
    return {**base, "parameters": parameters, "evidence": {"probability": 0.95}, **changes}


TRUE_STEP = {
    "effect": "range-step",
    "text": "RangeStep()",
    "stations": ["S2"],
    "targets": [],
    "observables": ["distance"],
    "covariates": ["time"],
    "parameters": [{"name": "range-step", "value": 11.5, "unit": "um"}],
    "shape": {},
}


def test_a_name_counts_when_it_is_first_or_among_three_equivalents() -> None:
    others = [{"effect": e, "probability": 0.1} for e in ("a", "b", "range-step", "c")]
    assert _named(TRUE_STEP, finding("range-step"))["named_first"]
    stated = _named(TRUE_STEP, finding("station-weather", equivalents=others))
    assert stated["named"]
    assert not stated["named_first"]
    assert not _named(TRUE_STEP, finding("station-weather", equivalents=[others[3], *others]))["named"]
    assert not _named(TRUE_STEP, None)["named"]


@pytest.mark.parametrize(
    ("where", "right"),
    [({}, True), ({"stations": ["S1"]}, False), ({"stations": []}, False), ({"observables": []}, False)],
)
def test_the_place_is_right_when_stations_targets_and_observables_are(where: dict[str, Any], right: bool) -> None:
    told = finding("range-step")
    told["where"] = {**told["where"], **where}
    assert _named(TRUE_STEP, told)["right_place"] is right


def test_a_parameter_is_covered_within_1_96_sigma() -> None:
    assert _coverage(TRUE_STEP, finding("range-step"))["covered"] == 1
    far = {**TRUE_STEP, "parameters": [{"name": "range-step", "value": 12.1, "unit": "um"}]}
    assert _coverage(far, finding("range-step")) == {"parameters": 1, "covered": 0, "misses": "range-step:-2.1"}


def test_a_pair_needs_a_finding_for_each_of_its_effects() -> None:
    other = {**TRUE_STEP, "effect": "backlash"}
    both = [finding("backlash"), finding("range-step")]
    assert _pair([TRUE_STEP, other], both)["pair_named"] == 2
    merged = [finding("backlash", equivalents=[{"effect": "range-step", "probability": 0.3}])]
    assert _pair([TRUE_STEP, other], merged)["pair_stated"] == 1


def test_errors_of_targets_do_not_depend_on_the_frame() -> None:
    rng = stream(4, "points")
    truth = rng.uniform(0.0, 6.0, (28, 3))
    shaken = truth + 1e-5 * rng.standard_normal(truth.shape)
    moved = shaken @ from_rotation_vector(np.array([0.3, -1.0, 2.0])).T + [1.0, 2.0, 3.0]
    assert rigid_error(moved, truth) == pytest.approx(rigid_error(shaken, truth), rel=1e-6)
    assert 10.0 < rigid_error(shaken, truth) < 20.0


def test_shares_come_with_their_binomial_interval() -> None:
    found = rate([True] * 19 + [False])
    assert (found["right"], found["of"]) == (19, 20)
    assert found["low"] == pytest.approx(0.7513, abs=1e-3)  # Clopper and Pearson
    assert found["high"] == pytest.approx(0.9987, abs=1e-3)
    assert rate([])["of"] == 0


def test_a_recording_is_diagnosed_by_a_process_that_has_its_folder_only(tmp_path: Path, root: Path) -> None:
    hidden = case("single", 600, 2)
    conceal(hidden, tmp_path / "recordings", tmp_path / "sealed")
    worker = root / "experiments" / "20_concealed_physics" / "concealed" / "examine.py"
    folders = [str(tmp_path / "recordings"), str(tmp_path / "diagnoses")]
    subprocess.run([sys.executable, str(worker), *folders, hidden.name], check=True, timeout=300, cwd=root)
    truth = json.loads((tmp_path / "sealed" / f"{hidden.name}.json").read_text(encoding="utf-8"))
    row = score(truth, tmp_path / "diagnoses" / hidden.name)
    assert row["exit"] == 0, row["complaint"]
    assert row["found"]
    assert row["named"], row["answer"]
    assert len(read(tmp_path / "recordings" / hidden.name)) == row["pointings"]


def law(carrier: str, strengths: tuple[float, float, float], words: tuple[str, ...]) -> dict[str, Any]:
    return {"words": {"carrier": carrier}, "strengths": strengths, "told_as": {"carrier": words}}


def told(carrier: str, observables: tuple[str, ...], scatter: dict[str, float] | None = None) -> dict[str, Any]:
    parameters = [{"name": f"noise-{n}", "value": v, "sigma": 0.1} for n, v in (scatter or {}).items()]
    return {"carrier": carrier, "where": {"observables": list(observables)}, "parameters": parameters}


STAND, YAW = ("stand", "station"), ("stand", "station", "azimuth")


@pytest.mark.parametrize(
    ("effect", "finding", "right"),
    [
        (law("station", (0, 30, 170), STAND), told("lean of the stand", ("azimuth", "elevation")), True),
        (law("station", (0, 2, 198), STAND), told("lean of the stand", ("azimuth", "elevation")), True),
        (law("station", (80, 0, 120), STAND), told("place of targets", ()), False),
        (law("station", (80, 0, 120), STAND), told("elevation", ("elevation",)), False),
        (law("targets", (5, 0, 195), ("target",)), told("elevation", ("elevation",)), True),
        (law("targets", (5, 0, 195), ("target",)), told("distance", ("distance",)), False),
        (law("yaw", (0, 200, 0), YAW), told("azimuth eccentricity", ()), False),
        (law("yaw", (0, 200, 0), YAW), told("azimuth", ("azimuth",)), True),
        (law("distance", (200, 0, 0), ("distance",)), told("distance", ("distance",)), True),
        (law("distance", (200, 0, 0), ("distance",)), told("distance per metre", ()), False),
        (law("noise", (60, 70, 70), ("noise",)), told("", ()), True),
        (law("noise", (0, 200, 0), ("noise",)), told("", (), {"distance": 0.1, "azimuth": 3.0}), True),
        (law("noise", (0, 200, 0), ("noise",)), told("", (), {"distance": 1.0, "azimuth": 3.0}), False),
        ({"words": {"carrier": "lean of the station"}, "strengths": (0, 9, 91)}, told("stand about x", ()), True),
        ({"words": {}, "strengths": (0, 9, 91)}, told("stand about x", ()), False),
    ],
)
def test_an_observable_is_right_when_it_shows_the_law_or_what_moves_is_told(
    effect: dict[str, Any], finding: dict[str, Any], right: bool
) -> None:
    assert (_score._moves_alike(effect, finding) or _score._told(finding) == _score._shown(effect)) is right


def test_what_an_observable_has_in_a_strength_adds_up_and_leaves_others_alone() -> None:
    scene = draw_scene(stream(7, "strengths"))
    space = space_of([], scene)
    sloped = Hidden(Invented((), (), next(n for n in SETS["first"] if ALL[n][0] == "azimuth"), (0.3,) * 5), np.ones(1))
    parts = _hidden.strengths(space, sloped)
    assert parts.sum() == pytest.approx(strength(space, sloped), rel=1e-6)
    assert parts[[0, 2]] == pytest.approx([0.0, 0.0], abs=1e-9 * parts[1])


def test_a_true_vector_stands_in_the_frame_of_the_adjustment() -> None:
    scene = draw_scene(stream(7, "frames"))
    found = adjust(measured(scene, [], stream(7, "noise")), misalignment()).state
    turn = np.array([a @ b.T for a, b in zip(found.rotation, scene.state.rotation, strict=True)]) - np.eye(3)
    assert np.abs(turn).max() < 0.01
    assert np.abs(found.points - scene.state.points).max() < 0.05


def test_laws_that_look_like_cards_are_those_of_the_samples(root: Path) -> None:
    """The table by which names are doubted, counted again in the results."""
    names = ("seventh", "eighth", "tenth", "eleventh", "thirteenth", "fourteenth", "fifteenth", "sixteenth")
    invented, alike = 0, Counter[str]()
    for name in names:
        with (root / "results" / "20_concealed_physics" / name / "recordings.csv").open(encoding="utf-8") as file:
            rows = [row for row in csv.DictReader(file) if row["kind"] == "unknown" and row["nearest_share"]]
        invented += len(rows)
        alike.update(row["nearest_known"] for row in rows if float(row["nearest_share"]) > 0.85)
        noise = ("turbulence", "noise-level", "station-noise")
        alike.update(row["first"] for row in rows if row["first"] in noise and row["called_unknown"] == "False")
    assert (invented, dict(alike)) == (INVENTED, RESEMBLED)
