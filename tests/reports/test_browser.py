"""The page in a real browser: no console error, no outside request, the 3D canvas drawn, no sideways scroll."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ltsim.core.results import Table
from ltsim.reports import workshop_scene
from ltsim.reports.document_model import Document, Section, table_blocks
from ltsim.reports.page import page_html
from ltsim.reports.scene_page import scene_page
from ltsim.reports.verbs import report
from tests.reports import samples
from tests.reports.browser import find_browser, visit

PROBE = """<script>addEventListener("load", () => {
  document.querySelectorAll("details").forEach(part => part.open = true);
  const wide = [...document.querySelectorAll(".wide")].filter(table => table.scrollWidth > table.clientWidth + 1);
  const names = wide.map(table => table.closest(".table").querySelector("h3").textContent);
  const broken = [];
  document.querySelectorAll("td").forEach(cell => {
    const node = [...cell.childNodes].find(child => child.nodeType === Node.TEXT_NODE);
    if (!node || !/^[−-]?[0-9.]+( ± [0-9.]+)?$/.test(node.data.replace(/\\u00a0/g, " "))) return;
    const range = document.createRange();
    range.selectNodeContents(node);
    if (new Set([...range.getClientRects()].map(line => line.top)).size > 1) broken.push(node.data);
  });
  const width = `WIDTH ${document.documentElement.scrollWidth} of ${innerWidth}`;
  console.log(`${width}, cut: ${names.join(", ") || "none"}, broken: ${broken.join(", ") || "none"}`);
});</script></body>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    find_browser()
    return report(samples.calibration_folder(tmp_path_factory.mktemp("page")))


def clean(console: list[str]) -> list[str]:
    """Console lines but the viewer's greeting and our probe."""
    return [line for line in console if '"hashes,scene"' not in line and "WIDTH" not in line]


def test_scene_is_drawn_without_asking_anybody(tmp_path: Path) -> None:
    find_browser()
    file = tmp_path / "scene.html"
    file.write_text(scene_page(workshop_scene.workshop_from_recording(samples.recording())))
    page_view = visit(file, tmp_path, width=900, height=700)
    assert clean(page_view.console) == []
    assert page_view.asked == []
    middle = page_view.picture[150:600, 200:700]
    assert len(np.unique((255 * middle).astype(np.uint8).reshape(-1, 3), axis=0)) > 300
    assert (middle < 0.97).any(axis=2).mean() > 0.5


TOUCH = """<script>
Element.prototype.setPointerCapture = Element.prototype.releasePointerCapture = () => {};  // knows real fingers alone
addEventListener("load", () => setTimeout(() => {
  const touch = (kind, x) => document.querySelector("canvas").dispatchEvent(new PointerEvent(kind, {
    bubbles: true, cancelable: true, pointerType: "touch", pointerId: 7, isPrimary: true, button: 0,
    buttons: kind === "pointerup" ? 0 : 1, clientX: x, clientY: 300, pageX: x, pageY: 300 }));
  touch("pointerdown", 300);
  for (let k = 1; k <= 12; k++) setTimeout(() => touch("pointermove", 300 + 15 * k), 50 * k);
  setTimeout(() => touch("pointerup", 480), 800);
}, 2000));</script></body>"""


def test_scene_turns_by_touch(tmp_path: Path) -> None:
    find_browser()
    still, turned = tmp_path / "still.html", tmp_path / "turned.html"
    html = scene_page(workshop_scene.workshop_from_recording(samples.recording()))
    still.write_text(html)
    turned.write_text(TOUCH.join(html.rsplit("</body>", 1)))
    before, after = (visit(file, tmp_path, width=700, height=600).picture for file in (still, turned))
    moved = np.abs(before - after).max(axis=2)[150:500] > 0.1
    assert moved.mean() > 0.05


def test_report_opens_without_error_or_request(page: Path, tmp_path: Path) -> None:
    page_view = visit(page, tmp_path, height=3000)
    assert clean(page_view.console) == []
    assert page_view.asked == []
    dark = (page_view.picture < 0.6).all(axis=2).mean(axis=1)
    assert (dark > 0).mean() > 0.3


def test_canvas_of_the_report_is_drawn(page: Path, tmp_path: Path) -> None:
    file = tmp_path / "only-scene.html"
    html = page.read_text()
    style = "<style>header, main > section > :not(figure:has(.scene)), figure > h3 { display: none }</style></head>"
    click = '<script>addEventListener("load", () => document.querySelector(".scene button").click())</script></body>'
    file.write_text(html.replace("</head>", style, 1).replace("</body>", click, 1))
    page_view = visit(file, tmp_path, width=1000, height=640)
    assert clean(page_view.console) == []
    middle = page_view.picture[150:500, 250:750]
    assert len(np.unique((255 * middle).astype(np.uint8).reshape(-1, 3), axis=0)) > 300


@pytest.mark.parametrize(
    "kind", ["calibration", *(pytest.param(k, marks=pytest.mark.long) for k in ("history", "next", "plan", "campaign"))]
)
def test_a_phone_never_scrolls_sideways(kind: str, page: Path, tmp_path: Path) -> None:
    made = {"history": samples.history_folder, "next": samples.next_folder, "plan": samples.plan_folder}
    made["campaign"] = samples.campaign_folder
    html = page.read_text() if kind == "calibration" else report(made[kind](tmp_path / kind)).read_text()
    assert_nothing_is_cut_on_a_phone(html, tmp_path)


def test_coordinates_of_a_large_hall_are_not_cut_on_a_phone(tmp_path: Path) -> None:
    columns = {name: [-112345.6789, 98765.4321] for name in ("x [mm]", "y [mm]", "z [mm]")}
    columns |= {f"U {axis} [um]": [1048.0, 1049.0] for axis in "xyz"}
    table = Table.from_columns("targets", {"name": ["M01", "pillar north"], **columns})
    shown = replace(
        table, columns=tuple(replace(c, display_format=".4f" if "mm" in c.name else ".0f") for c in table.columns)
    )
    section = Section("Targets", "Network", "Two targets.", blocks=table_blocks("Targets", shown))
    assert_nothing_is_cut_on_a_phone(page_html(Document("Targets", "", "plain", [section])), tmp_path)


def test_numbers_with_many_digits_do_not_break_on_a_phone(tmp_path: Path) -> None:
    """A coordinate broke as `-1103.115` and `2`."""
    columns: dict[str, list[str]] = {name: ["-1103.1152", "-112345.6789"] for name in ("x", "y", "z")}
    columns |= {"error": ["-1103.1152 +- 1048.0012", "0.28 +- 0.21"], "meaning": ["a sentence of several words", "-"]}
    table = Table.from_columns("targets", {"name": ["M01", "pillar north"], **columns})
    section = Section("Targets", "Network", "Two targets.", blocks=table_blocks("Targets", table))
    assert_nothing_is_cut_on_a_phone(page_html(Document("Targets", "", "plain", [section])), tmp_path)


def assert_nothing_is_cut_on_a_phone(html: str, tmp_path: Path) -> None:
    """Check of the widths of the page and of its tables in a frame of 390 pixels."""
    inner = tmp_path / "inner.html"
    inner.write_text(html.replace("</body>", PROBE))
    outer = tmp_path / "phone.html"
    outer.write_text(
        '<body style="margin:0"><iframe src="inner.html" style="border:0;width:390px;height:3000px"></iframe>'
    )
    page_view = visit(outer, tmp_path, width=600, height=3000)
    assert clean(page_view.console) == []
    lines = [line for line in page_view.console if "WIDTH" in line]
    assert len(lines) == 1
    assert "WIDTH 390 of 390, cut: none, broken: none" in lines[0]
