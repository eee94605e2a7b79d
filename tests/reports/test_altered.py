"""Result files with altered values: a section, or one sentence that says what is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ltsim.core.errors import LtsimError
from ltsim.core.limits import MAX_FIGURE_ITEMS, MAX_RESULT_LIST_ENTRIES
from ltsim.recordings.result_file import read_result
from ltsim.reports.page import document_of_folder, page_html
from ltsim.reports.schemas import MODEL_BY_FILE_NAME
from ltsim.reports.sections import SECTION_FUNCTION_BY_RESULT_FILE, read_content, result_section
from tests.reports import samples
from tests.reports.test_page import Reader, parsed

VALUES = (0, -1, 1e30, 1e-320, float("nan"), "x" * 3000, "", [], {}, None, True)
FIT = {"chi2": 310.0, "dof": 300, "sigma0": 1.02, "p_value": 0.3, "status": "converged"}
CHANGE = {
    "from": "may", "to": "june", "chi2": 9.0, "dof": 2, "p_value": 0.01, "changed_parameters": ["beam-tilt"],
    "parameters": [{"name": "beam-tilt", "difference": 3.0, "sigma": 1.0, "unit": "urad", "p_value": 0.003}],
}  # fmt: skip
COMBINED = {"combination": {"vertical-index": 1.0, "transit-tilt": -0.4}, "value": 2.0, "sigma": 0.1, "unit": "urad"}
CONTENTS: dict[str, dict[str, Any]] = {
    "diagnosis.json": samples.DIAGNOSIS
    | {
        "instruments": [
            {
                "name": "T", "determined": [COMBINED],
                "parameters": [{"name": "beam-tilt", "value": 9.0, "sigma": 0.5, "unit": "urad"}],
            },
        ],
        "detectable": [{"effect": "air-gradient", "parameter": "gradient", "size": 3.0, "unit": "ppm"}],
    },
    "calibration.json": {
        "format": "ltsim-calibration/1", "construction": "misalignment", "fit": FIT, "covariance": [[1.0]],
        "parameters": [{"name": "beam-tilt", "value": 9.0, "sigma": 1.0, "unit": "urad", "prior_sigma": 9.7}],
        "determined": [COMBINED],
        "undetermined": [{"combination": {"beam-tilt": 1.0}, "gain": 0.1, "cure": "two faces"}],
        "stations": [{"name": "S1", "position_mm": [1.0, 2.0, 3.0], "rotation_quaternion": [0, 0, 0, 1]}],
        "correction": {
            "prior_scale": 1.0, "prior_scale_limits": [0.5, 2.0], "uncorrected_error_um": 30.0,
            "corrected_error_um": 6.0, "noise_error_um": 9.0,
        },
        "effects": [{"effect": "air-gradient", "chi2_drop": 9.0, "n_distinguishable_parameters": 1, "n_candidates": 3,
                     "parameters": [{"name": "gradient", "value": 3.0, "sigma": 1.0, "unit": "ppm"}]}],
    },
    "history.json": {
        "format": "ltsim-history/1", "construction": "misalignment",
        "calibrations": [{"label": "may", "fit": FIT}, {"label": "june", "fit": FIT}],
        "parameters": [{"name": "beam-tilt", "unit": "urad", "values": [1.0, 4.0], "sigmas": [0.7, 0.7], "mean": 2.5,
                        "between_calibration_sigma": 1.0, "constancy_test": {"chi2": 9.0, "dof": 1, "p_value": 0.003}}],
        "changes": [CHANGE], "change_since_first": CHANGE,
        "events": [{"from": "may", "to": "june", "name": "beam-tilt", "difference": 3.0, "sigma": 1.0,
             "usual_step_sigma": 0.4,
                    "unit": "urad", "p_value": 0.003}],
    },
    "comparison.json": {
        "format": "ltsim-comparison/1", "second_recording": {"pointings": 9, "digest": "d"}, "sentence": "T1 moved",
        "significance_level": 0.05, "statistic": 30.0,
        "dof": 3, "p_value": 1e-5, "p_value_without_moved_points": 0.4, "scale_ppm": 0.3, "notes": ["a note"],
        "displacements": [{
            "target": "T1", "moved": True, "position_mm": [1.0, 2.0, 3.0], "displacement_um": [90.0, 1.0, 1.0],
            "sigma_um": [9.0, 9.0, 9.0], "covariance_um2": [[81.0, 0, 0], [0, 81.0, 0], [0, 0, 81.0]],
            "semi_axes_um": [25.0, 25.0, 25.0], "p_value": 1e-5, "detectable_um": [30.0, 40.0],
        }],
    },
    "uncertainty.json": {
        "format": "ltsim-uncertainty/1", "title": "", "source": "rec", "coverage_probability": 0.95,
        "trials": 10000, "frame": "", "sigma0": 1.0, "correlation": [[1.0]], "warnings": ["a warning"],
        "results": [{
            "task": "length", "kind": "distance", "name": "distance", "unit": "mm", "value": 7934.1,
            "standard_uncertainty": 0.01, "coverage_factor": 2.0, "expanded_uncertainty": 0.02,
            "nonlinearity_ratio": 0.0,
            "monte_carlo": {"mean": 7934.1, "standard_uncertainty": 0.01, "symmetric_interval": [7934.08, 7934.12],
                            "shortest_interval": [7934.08, 7934.12], "is_stable": True, "intervals_agree": True},
            "budget": [{"source": "noise", "evaluation_type": "A", "variance_fraction": 1.0,
                        "standard_uncertainty": 0.01}],
            "conformity": {"lower": 7934.0, "upper": None, "rule": "guarded", "guard_band": 0.02,
                           "conformity_probability": 1.0, "judgement": "accepted", "wrong_decision_probability": 0.0},
        }],
    },
    "check.json": {
        "format": "ltsim-check/1", "passed": False, "sentence": "no-go", "level": 0.01, "tests": [],
        "items": [{"station": "S1", "kind": "bump", "passed": False, "sentence": "it moved", "p_value": 0.001,
                   "targets": ["T1"]}],
    },
    "accept.json": {
        "format": "ltsim-accept/1", "error_origin": "predicted", "plan_name": "asme-b89.4.19-2006",
        "pass_probability": 0.9,
        "sentence": "fine",
        "specification": {"name": "a tracker", "transverse_limit_um": 15, "transverse_limit_um_per_m": 6,
                          "range_limit_um": 10, "range_limit_um_per_m": 1},
        "groups": [{"name": "length", "n_tests": 1, "pass_probability": 0.9, "largest_limit_ratio": 0.8}],
        "tests": [{"name": "a", "group": "length", "limit_um": 30.0, "error_um": 9.0, "expanded_uncertainty_um": 4.0,
                   "pass_probability": 0.9}],
        "sensitivities": [{"name": "beam-tilt", "unit": "urad", "prior_sigma": 9.7, "smallest_failing_value": 30.0,
                           "failing_test": "a"}],
        "worst_passing_instrument": {"constants": {"beam-tilt": 30.0}, "rms_point_error_um": 40.0,
                                     "largest_point_error_um": 90.0},
    },
    "next.json": {
        "format": "ltsim-next/1", "compared_effects": ["vertical-index", "transit-tilt"], "advice": "measure",
        "present_chi2_differences": {"transit-tilt": 1.0},
        "proposals": [{"action": "two faces", "minutes": 9.0, "remaining_sigma_fraction": 0.7,
                       "most_improved_parameter": "beam-tilt", "most_improved_sigma_fraction": 0.6,
                       "chi2_differences": {"transit-tilt": 9.0}, "separates_all_effects": True}],
    },
}  # fmt: skip


def altered(content: Any) -> Iterator[Any]:
    """Copies of JSON with one value replaced, one entry of a list gone or there twice, or one key gone."""
    if isinstance(content, dict):
        for key, inner in content.items():
            yield {k: v for k, v in content.items() if k != key}
            yield from (content | {key: value} for value in VALUES)
            yield from (content | {key: changed} for changed in altered(inner))
    elif isinstance(content, list) and content:
        yield from ([*content, content[0]], content[1:])
        yield from ([value, *content[1:]] for value in VALUES)
        yield from ([changed, *content[1:]] for changed in altered(content[0]))


def plan(folder: Path) -> dict[str, Any]:
    """Content of a plan with one station."""
    content: dict[str, Any] = json.loads((samples.plan_folder(folder) / "plan.json").read_text())
    content["reference_layout"]["stations"] = content["stations"] = content["stations"][:1]
    return content | {"settings": {"goal": {"confidence_level_pct": 95}, "floor": {"margin_mm": 500}}}


def sentence(file: Path, content: Any) -> str:
    """Text of the section of a file with a content, or the sentence that refuses it."""
    file.write_text(json.dumps(content))
    try:
        return result_section(read_content(file.parent, file.name)).terminal_text()
    except LtsimError as problem:
        says = str(problem)
        assert says.startswith(str(file)) and "\n" not in says and len(says) < len(str(file)) + 400
        return says


def test_there_is_a_sample_of_each_result_that_has_a_section() -> None:
    assert {*CONTENTS, "plan.json"} == {*SECTION_FUNCTION_BY_RESULT_FILE}


@pytest.mark.parametrize("name", SECTION_FUNCTION_BY_RESULT_FILE)
def test_altered_results_are_a_section_or_a_sentence(name: str, tmp_path: Path) -> None:
    content = CONTENTS[name] if name in CONTENTS else plan(tmp_path / "plan")
    read_result(_written(tmp_path / name, content), MODEL_BY_FILE_NAME[name])  # type: ignore[type-var]
    for number, changed in enumerate(altered(content)):
        try:
            assert sentence(tmp_path / name, changed)
        except Exception as problem:
            raise AssertionError(f"alteration {number} of {name}: {json.dumps(changed)[:2000]}") from problem


def _written(file: Path, content: Any) -> Path:
    file.write_text(json.dumps(content))
    return file


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.filterwarnings("ignore")  # as the command does
@pytest.mark.parametrize("name", SECTION_FUNCTION_BY_RESULT_FILE)
def test_altered_results_are_drawn_or_refused(name: str, tmp_path: Path) -> None:
    content = CONTENTS[name] if name in CONTENTS else plan(tmp_path / "plan")
    for number, changed in enumerate(altered(content)):
        _written(tmp_path / name, changed)
        try:
            for block in result_section(read_content(tmp_path, name)).blocks:
                assert getattr(block, "data_uri", "drawn")
        except LtsimError:
            continue
        except Exception as problem:
            raise AssertionError(f"alteration {number} of {name}: {json.dumps(changed)[:2000]}") from problem


HOSTILE = (
    """"'><img src=x onerror=alert(1)></title></style></script><script>alert(2)</script><svg onload=alert(3)>$^$"""
)
"""A text that leaves any quotes, attribute or element in which it stands unescaped."""


def with_text(content: Any, is_accepted: Callable[[Any], bool]) -> tuple[Any, int]:
    """JSON in which `HOSTILE` replaces each text, and each key beside, that may hold it, and their number."""
    count = 0

    def replaced(inner: Any, put: Callable[[Any], Any]) -> Any:
        """A part of the JSON with the text; `put` puts a part in its place in the whole."""
        nonlocal count
        if isinstance(inner, str) and is_accepted(put(HOSTILE)):
            count += 1
            return HOSTILE
        if isinstance(inner, dict):
            for key in list(inner):
                more = {(HOSTILE if k == key else k): v for k, v in inner.items()}
                if HOSTILE not in inner and all(isinstance(v, int | float) for v in inner.values()):
                    if is_accepted(put(more)):
                        count, inner = count + 1, more
                    break
            for key in list(inner):
                now = inner
                inner = now | {key: replaced(now[key], lambda v, now=now, key=key: put(now | {key: v}))}
        elif isinstance(inner, list):
            for i in range(len(inner)):
                now = inner
                changed = replaced(now[i], lambda v, now=now, i=i: put([*now[:i], v, *now[i + 1 :]]))
                inner = [*now[:i], changed, *now[i + 1 :]]
        return inner

    return replaced(content, lambda whole: whole), count


@pytest.mark.filterwarnings("ignore")  # as the command does
@pytest.mark.parametrize("name", SECTION_FUNCTION_BY_RESULT_FILE)
def test_markup_in_any_text_of_a_result_is_text_on_its_page(name: str, tmp_path: Path) -> None:
    content = CONTENTS[name] if name in CONTENTS else plan(tmp_path / "plan")
    n_scripts = page_of(tmp_path, name, content).tags.count("script")

    def is_accepted(changed: Any) -> bool:
        return not sentence(tmp_path / name, changed).startswith(str(tmp_path))

    hostile, count = with_text(content, is_accepted)
    assert count > 1
    page = page_of(tmp_path, name, hostile)
    assert any("alert(1)" in text for text in page.text)
    assert page.handlers == []
    assert "x" not in page.loads
    assert page.tags.count("script") == n_scripts


def page_of(folder: Path, name: str, content: Any) -> Reader:
    """Parsed page of a folder with one result; its text holds what the result says."""
    _written(folder / name, content)
    return parsed(page_html(document_of_folder(folder)))


def test_a_result_with_very_long_lists_is_refused_before_it_is_built(tmp_path: Path) -> None:
    """A list of 150,000 equal entries took 780 MB in a report, one of 72,000 stations more than a minute."""
    content = CONTENTS["calibration.json"]
    long = content | {"stations": content["stations"][:1] * (MAX_RESULT_LIST_ENTRIES + 1)}
    says = sentence(tmp_path / "calibration.json", long)
    assert f"stations has {MAX_RESULT_LIST_ENTRIES + 1} entries, expected at most {MAX_RESULT_LIST_ENTRIES}" in says


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ({"a": {f"k{i}": 1.0 for i in range(10_001)}}, "a has 10001 entries, expected at most 10000"),
        ([[1.0] * 10_001], "other has 10001 entries, expected at most 10000"),
        ({"a": "x" * 20_001}, "a has 20001 characters, expected at most 20000"),
        ([["x"] * 10_000] * 10, "has more than 100000 texts, lists and objects"),
        ([[[]] * 10_000] * 10, "has more than 100000 texts, lists and objects"),
        (["x" * 19_990] * 51, "characters, expected at most 1000000 together"),
        ([[1.0] * 10_000] * 20, ""),
    ],
)
def test_a_result_with_many_or_long_texts_is_refused_before_it_is_built(value: Any, says: str, tmp_path: Path) -> None:
    """Plans of 12 MB with 700,000 qualities, or of 29 MB with one text, took 960 and 740 MB in a report."""
    refusal = sentence(tmp_path / "calibration.json", CONTENTS["calibration.json"] | {"other": value})
    assert says in refusal
    assert bool(says) == ("calibration.json: " in refusal)


@pytest.mark.parametrize(
    ("name", "list_name"),
    [
        ("comparison.json", "displacements"),
        ("accept.json", "groups"),
        ("uncertainty.json", "results"),
        ("history.json", "parameters"),
    ],
)
def test_a_figure_of_very_many_items_is_a_note(tmp_path: Path, name: str, list_name: str) -> None:
    """Figures of 3,000 equal items took up to 92 s and 828 MB."""
    content = CONTENTS[name]
    assert content[list_name]
    many = content | {list_name: content[list_name][:1] * (MAX_FIGURE_ITEMS + 1)}
    page = page_of(tmp_path, name, many)
    assert any(f"are too many to draw; the limit is {MAX_FIGURE_ITEMS}" in text for text in page.text)


def test_characters_that_turn_the_direction_of_writing_do_not_reach_a_page(tmp_path: Path) -> None:
    content = CONTENTS["calibration.json"]
    content = content | {"recording": {"title": "safe\u202egpj.exe\u0007\u2066", "pointings": 1, "digest": "0"}}
    page = page_of(tmp_path, "calibration.json", content)
    text = "".join(page.text)
    assert "safe?gpj.exe??" in text
    assert not {c for c in text if not c.isprintable()} - set("\n\t\u00a0")
