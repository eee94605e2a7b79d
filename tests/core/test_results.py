"""One declaration of a table's columns feeds every form of it; results are values that can be kept."""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from matplotlib.figure import Figure

import ltsim as lt
from ltsim.adjustment import Adjustment
from ltsim.calibration.schema import VerdictEntry
from ltsim.core.equality import ValueEquality, equal_values
from ltsim.core.errors import ModelError, RecordError
from ltsim.core.results import Column, Result, Table, flag_columns, number_columns, text_columns
from ltsim.reports.plots import FIGURE_FUNCTION_BY_CLASS
from ltsim.reports.verbs import View
from ltsim.simulation.injector import DetectionCurve
from ltsim.simulation.scenario import Scenario
from tests.families import family

POINTS = Table(
    "points.csv",
    "where points are",
    (
        *text_columns(target="name"),
        Column("x_mm", "coordinate", csv_format=".6f", sigma_column="sigma_x_mm"),
        Column("sigma_x_mm", "its standard deviation", csv_format=".6f"),
        *number_columns(".3g", ".2f", share_percent="of all"),
        *flag_columns(moved="it moved"),
    ),
)
ROWS = [("=T1", 1000.12349, 0.0123, 12.5, True), ("T2", -1.0, None, float("nan"), False)]


@dataclass(frozen=True)
class Cloud(Result):
    """A small result."""

    points: np.ndarray
    name: str = "cloud"
    rows: Any = None

    def _summary_lines(self) -> list[str]:
        return [f"{self.name}: {len(self.points)} points"]

    def _table_makers(self) -> Any:
        return {"points": lambda: POINTS.with_rows(ROWS), "plain": lambda: {"n": [1, 2], "what": ["a", "b"]}}


def test_a_table_is_written_and_read_back():
    text = POINTS.with_rows(ROWS).csv_text()
    assert text.splitlines()[1] == "'=T1,1000.123490,0.012300,12.5,True"
    again = POINTS.parse_csv(text)
    assert again.column("target") == ["=T1", "T2"]
    assert again.column("moved") == [True, False]
    assert np.isnan(again.column("sigma_x_mm")[1])
    assert again.csv_text() == text
    with pytest.raises(RecordError, match="row 1, column x_mm: 'one' is not a number"):
        POINTS.parse_csv(text.replace("1000.123490", "one"))
    with pytest.raises(RecordError, match="the required column moved is missing"):
        POINTS.parse_csv(text.replace("moved", "went"))


def test_a_person_reads_value_and_sigma_together_with_units_at_the_head():
    table = POINTS.with_rows(ROWS)
    assert table.headings == ["target", "x [mm]", "share [%]", "moved"]
    assert table.displayed_cells() == [["=T1", "1000.123 +- 0.012", "12.50", "yes"], ["T2", "-1.00", "-", ""]]
    assert table.meanings["x [mm]"] == "coordinate"
    assert table.text().splitlines()[1].startswith("=T1     1000.123 +- 0.012")


def test_rows_come_from_sequences_mappings_and_objects():
    @dataclass
    class Row:
        n: int
        what: str

    table = Table("rows.csv", "rows", (*number_columns(n="number"), *text_columns(what="word")))
    made = [table.with_rows(rows) for rows in ([(1, "a")], [{"what": "a", "n": 1}], [Row(1, "a")])]
    assert made[0] == made[1] == made[2]
    assert made[0].json_rows() == [{"n": 1, "what": "a"}]
    with pytest.raises(ModelError, match="has 1 cells for 2 columns"):
        table.with_rows([(1,)])


def test_a_result_gives_its_tables_by_name():
    cloud = Cloud(np.zeros((2, 3)))
    assert repr(cloud) == "cloud: 2 points"
    assert cloud.table("plain").header == ["n", "what"]
    assert "<td>1000.123 +- 0.012</td>" in cloud._repr_html_()
    with pytest.raises(ModelError, match="no table of a Cloud called 'point'; did you mean points"):
        cloud.table("point")
    with pytest.raises(ModelError, match="a Cloud has no figure"):
        cloud.plot()


def test_results_are_equal_where_their_values_are():
    cloud, other = Cloud(np.array([[1.0, np.nan]])), Cloud(np.array([[1.0, np.nan]]))
    assert cloud == other
    assert hash(cloud) == hash(other)
    assert cloud != replace(other, points=np.array([[1.0, 2.0]]))
    assert cloud != replace(other, points=other.points.astype(np.float32))
    assert cloud != replace(other, name="fog")
    assert equal_values({"a": (1, np.arange(3))}, {"a": (1, np.arange(3))})
    assert equal_values(sp.csr_array(np.eye(3)), sp.csr_array(np.eye(3)))
    assert not equal_values(sp.csr_array(np.eye(3)), sp.csr_array(2 * np.eye(3)))
    assert not equal_values([1, 2], [1, 3])


def test_nested_data_classes_have_their_usual_representation():
    @dataclass(frozen=True)
    class Pair(ValueEquality):
        both: np.ndarray

    assert repr(Pair(np.ones(1))).endswith("Pair(both=array([1.]))")
    assert Pair(np.ones(2)) == Pair(np.ones(2))


@pytest.fixture(scope="module")
def results_by_name() -> dict[str, Any]:
    recording = lt.simulate("paper-workshop", seed=7).recording
    calibration = lt.calibrate(recording)
    return {
        "recording": recording,
        "scenario": lt.scenario("paper-workshop"),
        "truth": lt.simulate("paper-workshop").truth,
        "calibration": calibration,
        "dh": lt.calibrate(recording, construction="dh"),
        "adjustment": calibration.adjustment,
        "criteria": lt.evaluate(recording, calibration),
        "history": lt.history([calibration, recording]),
        "check": lt.check(recording),
        "diagnosis": lt.diagnose(recording, held_out=False),
        "comparison": lt.compare(recording, recording, same_instrument=True),
        "catalogue": lt.catalogue("beam-tilt", "backlash"),
    }


NAMES = "recording scenario truth calibration dh adjustment criteria history check diagnosis comparison catalogue"


@pytest.mark.parametrize("name", NAMES.split())
def test_every_result_can_be_copied_pickled_and_compared(name: str, results_by_name):
    result = results_by_name[name]
    for again in (copy.copy(result), copy.deepcopy(result), pickle.loads(pickle.dumps(result))):
        assert again == result
        assert repr(again) == repr(result)
    assert all(other is result or other != result for other in results_by_name.values())


@pytest.fixture(scope="module", params=family(["cheap", "all"]))
def drawn(
    request: pytest.FixtureRequest, results_by_name: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> list[Any]:
    """Results that cost little in every run, one of every result in the long one."""
    if request.param == "cheap":
        return [result for name, result in results_by_name.items() if name not in ("truth", "catalogue")]
    recording, calibration, folder = (
        results_by_name["recording"],
        results_by_name["calibration"],
        tmp_path_factory.mktemp("results"),
    )
    small = {
        "format": "ltsim-campaign/1",
        "scenario": "paper-workshop",
        "trials": 3,
        "methods": [{"method": "network"}, {"method": "distance"}],
    }
    campaign = lt.campaign({**small, "statistics": ["errors"]}, out=folder / "campaign")
    chances = {f"{n}{e}": v for n in CHANCES for e, v in (("", 2.0), ("_low", 0.1), ("_high", 0.8))}
    row = {"noncentrality": 25.0, "largest_um": 20.0, "largest_urad": 5.0, "injections": 5, "right": 2.0} | chances
    plan = folder / "plan.toml"
    plan.write_text(
        'format = "ltsim-plan/1"\n[search]\nstarts = 1\ngrid_step_mm = 3000\nyaw_count = 1\nheight_count = 1\n'
    )
    return [
        *(result for name, result in results_by_name.items() if name not in ("truth", "catalogue")),
        lt.adjust(recording),
        lt.next_measurement(recording),
        lt.recover("paper-workshop", trials=3),
        lt.uncertainty(recording, {"task": [{"kind": "distance", "name": "d", "targets": ["T01", "T02"]}]}),
        lt.accept({"standard": "asme-b89.4.19-2006", "instrument": "leica-at500"}),
        lt.bench(Path(__file__).parents[2] / "docs" / "how-to" / "reflector.csv"),
        DetectionCurve("range-step", (), (row, row | {"noncentrality": 100.0})),
        lt.compare_calibrations("paper-workshop", {"network": calibration}, "paper-laboratory", seed=7),
        lt.view("paper-workshop"),
        lt.plan(plan),
        campaign,
        campaign.paired_differences("target_error_um", method=("network", "distance")),
    ]


CHANCES = ("detections", "placed", "named")
WITHOUT = {"EffectList", "Truth", "InjectedEffect", "InjectionTruth", "ManifestFile"}
"""Lists of words and sizes, and records of how a result was made."""


def final_kinds(kind: type) -> set[type]:
    """Classes derived from a class from which none is derived."""
    derived = kind.__subclasses__()
    return set().union(*map(final_kinds, derived)) if derived else {kind}


def test_every_figure_belongs_to_a_class_that_exists() -> None:
    for path in FIGURE_FUNCTION_BY_CLASS:
        module, _, name = path.rpartition(".")
        kind = getattr(import_module(module), name)
        assert issubclass(kind, Result) and f"{kind.__module__}.{kind.__qualname__}" == path


@pytest.mark.long
def test_every_result_is_drawn_with_what_its_axes_mean_and_has_a_table(
    drawn: list[Any], request: pytest.FixtureRequest
):
    if request.node.callspec.params["drawn"] == "all":
        for module in walk_packages(lt.__path__, "ltsim."):
            import_module(module.name)
        kinds = {kind.__name__ for kind in final_kinds(Result) if kind.__module__.startswith("ltsim.")}
        assert kinds - WITHOUT == {type(result).__name__ for result in drawn}
    for result in drawn:
        figure = result.plot()
        assert isinstance(figure, Figure)
        for ax in figure.axes:
            assert ax.lines or ax.collections or ax.patches or ax.texts, "no panel is empty without a word"
        labels = [words for ax in figure.axes for words in (ax.get_xlabel(), ax.get_ylabel())]
        labels += [ax.get_title(loc) for ax in figure.axes for loc in ("left", "right")]
        assert any(labels) or figure.get_supxlabel(), type(result)
        assert isinstance(result, View | Scenario | Adjustment) or len(result.to_dataframe().columns), type(result)


def test_every_table_of_every_result_reads_its_csv_file(drawn: list[Any]):
    for result in drawn:
        for name in result._table_makers():
            table = result.table(name)
            again = table.parse_csv(table.csv_text())
            assert again.header == table.header, (type(result), name)
            assert len(again.rows) == len(table.rows), (type(result), name)


def test_the_parts_of_a_result_are_compared_by_value(drawn: list[Any], results_by_name: dict[str, Any]):
    """Those of an adjustment are the solver's matrices, which nobody compares."""
    whole = [
        result
        for result in [*drawn, results_by_name["truth"]]
        if is_dataclass(result) and type(result) is not Adjustment
    ]
    for result in whole:
        held = [getattr(result, field.name) for field in fields(result)]
        parts = [part for value in held for part in (value if isinstance(value, tuple) else (value,))]
        for part in filter(is_dataclass, parts):
            assert copy.deepcopy(part) == part, (type(result), type(part))


def test_results_are_a_few_lines_and_their_tables_data_frames(drawn: list[Any]):
    pandas = pytest.importorskip("pandas", reason="the extra 'pandas' is not installed")
    for result in drawn:
        assert 20 < len(repr(result)) < 1000, repr(result)
        assert repr(result).count("\n") < 8
        for name in result._table_makers():
            frame = result.to_dataframe(name)
            assert isinstance(frame, pandas.DataFrame), (type(result), name)
            assert len(frame.columns) or name == "z_scores", type(result)  # which the campaign here does not ask for


def test_what_has_no_table_says_so():
    with pytest.raises(ModelError, match=r"^View has no table$"):
        lt.view("paper-workshop").to_dataframe()


def test_what_has_no_picture_says_so(results_by_name):
    with pytest.raises(ModelError, match="has no figure"):
        results_by_name["catalogue"].plot()


def test_a_coordinate_that_rounds_to_zero_has_no_sign() -> None:
    column = Column("x_mm", "coordinate", display_format=".4f", uncertainty_column="sigma_x_mm")
    assert [column.displayed_text(v) for v in (-1.7e-22, -0.00004, -0.00006, 0.0)] == [
        "0.0000",
        "0.0000",
        "-0.0001",
        "0.0000",
    ]
    assert column.displayed_text(-1e-9, 0.02) == "0.000"


def test_a_copy_of_an_entry_refuses_a_name_that_is_no_field() -> None:
    entry = VerdictEntry(case="clean", sentence="", is_sigma0_credible=False)
    assert entry.with_values(sentence="x").sentence == "x"
    with pytest.raises(TypeError, match="VerdictEntry has no field sentense"):
        entry.with_values(sentense="x")


def test_an_empty_unit_overrides_the_unit_in_the_name() -> None:
    assert Column("quantile_5_percent").heading == "quantile 5 [%]"
    assert Column("quantile_5_percent", title="5 % quantile", unit="").heading == "5 % quantile"
