"""The catalogue: what ships, and what a package of somebody else adds."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest

from ltsim.core.errors import ModelError
from ltsim.physics.effects import EFFECT_CLASSES_BY_GROUP
from ltsim.physics.effects.backlash import Backlash
from ltsim.physics.effects.beam_tilt import BeamTilt
from ltsim.physics.effects.catalogue import (
    BUILTIN_PROVIDER_NAME,
    DOCSTRING_SECTIONS,
    PACKAGE_EFFECTS_HEADING,
    Catalogue,
    CatalogueEntry,
)
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter

CARD = """Cold: it is cold.

Delta_d = c.

Size: 1 um.
Similar to: nothing.
Separate by: a stove.
Validity: in winter.
Source: none.
Validation: not validated.
"""


def made(name: str, doc: str = CARD, **attributes: object) -> type[Effect]:
    base = {
        "name": name,
        "light_path_stage": LightPathStage.RANGE,
        "parameters": (Parameter("c", "um", "cold", 1e-6),),
        "__doc__": doc,
    }
    base["design"] = lambda self, sightings: None
    return dataclass(frozen=True)(type("Cold", (Effect,), base | attributes))


@pytest.fixture
def strange(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = ModuleType("a_strangers_effects")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module


def catalogue(module: ModuleType, **kinds: object) -> Catalogue:
    for name, kind in kinds.items():
        setattr(module, name, kind)
    points = [EntryPoint(name, f"{module.__name__}:{name}", "ltsim.effects") for name in kinds]
    return Catalogue({"axes": (BeamTilt, Backlash)}, lambda: points)


def test_installed_effects_follow_the_shipped_ones_by_name(strange: ModuleType) -> None:
    effects = catalogue(strange, Warm=made("warmth"), Cold=made("cold"))
    assert [kind.name for kind in effects] == ["beam-tilt", "backlash", "cold", "warmth"]
    assert (effects.entries["cold"].group, effects.entries["backlash"].provider) == (
        PACKAGE_EFFECTS_HEADING,
        BUILTIN_PROVIDER_NAME,
    )
    assert effects.find("warmth") is effects[-1]


def test_shipped_effects_are_listed_without_a_search_for_packages() -> None:
    def never() -> list[EntryPoint]:
        raise AssertionError

    assert Catalogue(EFFECT_CLASSES_BY_GROUP, never).find("head-sag").name == "head-sag"


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (Path, "not a class derived from lt.Effect"),
        (made("backlash"), "ltsim has an effect 'backlash' already"),
        (made("Cold"), "lower-case words"),
        (made("cold", parameters=()), "lacks a light_path_stage or parameters"),
        (made("cold", base_rate=0.0), "its base_rate is 0.0, expected a positive number"),
        (made("cold", parameters=(Parameter("c", "furlong", "", 1.0),)), "unit 'furlong' of c is not one of um, mm"),
        (made("cold", CARD.replace("Validity: in winter.\n", "")), "the sections Size, Similar to"),
        (type("Cold", (Effect,), {"name": "cold"}), "its class lacks design"),
    ],
)
def test_an_effect_that_does_not_fit_is_refused_in_a_sentence(strange: ModuleType, kind: object, says: str) -> None:
    effects = catalogue(strange, Cold=kind)
    with pytest.raises(
        ModelError, match=r"the effect 'Cold' \(a_strangers_effects:Cold of .*\) cannot be used: "
    ) as caught:
        list(effects)
    assert says in str(caught.value)
    assert str(caught.value).endswith("; repair or uninstall that package")


def test_two_packages_with_the_same_name_are_distinguished(strange: ModuleType) -> None:
    with pytest.raises(ModelError, match="has an effect 'cold' already"):
        list(catalogue(strange, One=made("cold"), Two=made("cold")))


def test_an_entry_point_that_fails_is_named() -> None:
    points = [EntryPoint("cold", "no_such_module:Cold", "ltsim.effects")]
    with pytest.raises(ModelError, match="ModuleNotFoundError: No module named 'no_such_module'"):
        len(Catalogue({}, lambda: points))


def test_a_card_is_read_by_its_parts() -> None:
    card = CatalogueEntry.from_docstring(CARD)
    assert (card.title, card.cause_description, card.equation) == ("Cold", "it is cold", "Delta_d = c.")
    assert card.sections()[2] == (DOCSTRING_SECTIONS[2], "a stove.")
    for broken in (
        CARD.replace("Cold: ", "Cold, "),
        CARD.replace("Similar", "Alike"),
        CARD.replace("Delta_d = c.\n", ""),
    ):
        with pytest.raises(ModelError, match=r"docstring"):
            CatalogueEntry.from_docstring(broken)


SESSION = """
import contextlib, io
from ltsim.cli.main import run
for verb in (["effects"], ["effects", "cable-drag"]):
    assert run(verb) == 0
    print("----")
with contextlib.redirect_stdout(io.StringIO()) as scenario:
    run(["simulate", "paper-workshop", "--show"])
open("scenario.toml", "w").write(scenario.getvalue() + open("entry.toml").read())
"""


@pytest.fixture(scope="module")
def package(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example package of the documentation, installed by pip into a folder of its own."""
    target = tmp_path_factory.mktemp("packages")
    offline = ["--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check", "-q"]
    source = root / "docs" / "example-effect"
    install = [sys.executable, "-m", "pip", "install", *offline, "--target", str(target), str(source)]
    subprocess.run(install, check=True, capture_output=True, text=True)
    return target


def test_the_example_package_is_simulated_fitted_and_diagnosed(package: Path, root: Path, tmp_path: Path) -> None:
    """What its README says, done."""
    readme = (root / "docs" / "example-effect" / "README.md").read_text(encoding="utf-8")
    entry, code = (re.search(rf"```{kind}\n(.*?)```", readme, re.DOTALL)[1] for kind in ("toml", "python"))  # type: ignore[index]

    (tmp_path / "session.py").write_text(SESSION + code, encoding="utf-8")
    (tmp_path / "entry.toml").write_text(entry, encoding="utf-8")
    shown = {**os.environ, "PYTHONPATH": str(package)}
    done = subprocess.run(
        [sys.executable, "session.py"], check=True, capture_output=True, text=True, cwd=tmp_path, env=shown
    )
    listed, card, report = done.stdout.split("----\n")
    assert re.search(r"^installed\n  cable-drag +Cable drag: .* \[ltsim-cable-drag 1.0\]$", listed, re.MULTILINE)
    assert "Comes from   ltsim-cable-drag 1.0" in card
    fitted, summary = report.splitlines()
    value, sigma = (float(x) for x in re.findall(r"[0-9.]+(?:e-?[0-9]+)?", fitted))
    assert sigma < 0.5
    assert abs(value - 6.0) < 4 * sigma
    assert summary.startswith("Cable drag (in azimuth)")
