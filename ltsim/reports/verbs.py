"""Public functions `view` and `report`: the hall in 3D, and the report page."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path

from ltsim.core.arguments import check_argument_choice, path_argument, path_of_file_or_built_in
from ltsim.core.errors import require_extra
from ltsim.core.results import Result
from ltsim.core.storage import check_writable
from ltsim.recordings import Recording
from ltsim.recordings.exchange import read
from ltsim.recordings.files import write_text
from ltsim.recordings.setup import ReportHeader
from ltsim.reports.page import REPORT_PAGE_FILE_NAME, UNREADABLE_SECTION_KIND, document_of_folder, page_html
from ltsim.reports.workshop_scene import (
    WorkshopScene,
    workshop_from_recording,
    workshop_from_scenario,
    workshop_with_cad,
)
from ltsim.scene.cad import UNIT_NAMES
from ltsim.simulation.builtin import builtin_names
from ltsim.simulation.scenario import Scenario


@dataclass(frozen=True, repr=False)
class View(Result):
    """3D view of a hall: interactive in a notebook, or as a picture, a page or a window."""

    workshop: WorkshopScene
    """Scene of the hall that the view shows."""

    def _summary_lines(self) -> list[str]:
        """Line for a terminal: title, numbers of stations and targets, and methods."""
        w = self.workshop
        title = f"{w.title}: " if w.title else ""
        return [
            f"View: {title}{len(w.stations)} stations, {len(w.targets)} targets; write_png(), write_html() or show()"
        ]

    def _repr_html_(self) -> str:
        """HTML of the interactive view, which a notebook shows."""
        from ltsim.reports.scene_page import scene_page  # pyvista takes a second to load

        return f'<iframe srcdoc="{escape(scene_page(self.workshop))}" width="100%" height="600"></iframe>'

    def write_png(self, path: str | Path) -> None:
        """Write the view as a PNG picture."""
        from ltsim.reports import scene3d

        check_writable(Path(path), is_folder=False)
        write_text(Path(path), scene3d.scene_png(self.workshop))

    def write_html(self, path: str | Path) -> None:
        """Write an interactive page for a browser, which works offline."""
        from ltsim.reports.scene_page import scene_page

        check_writable(Path(path), is_folder=False)
        write_text(Path(path), scene_page(self.workshop))

    def show(self) -> None:
        """Open a window with the 3D view; returns when it is closed."""
        from ltsim.reports import scene3d

        scene3d.show_window(self.workshop)


def view(
    source: Recording | Scenario | str | Path,
    *,
    cad: str | Path | None = None,
    cad_unit: str | None = None,
    cad_up: str | None = None,
    colour: str = "incidence",
) -> View:
    """3D view of a hall: stations, shadow cones, targets, lines of sight, uncertainty, corrections.

    Parameters
    ----------
    source : Recording, Scenario, str or Path
        Recording (adjusted first) or scenario, its file, or the name of a built-in scenario.
    cad : str or Path, optional
        CAD file (STL, OBJ, PLY, GLB, STEP or IGES) that is shown in the hall.
    cad_unit : {`mm`, `m`, `in`}, optional
        Unit of the coordinates in the CAD file; default by its format (glTF: metres; STEP: declared in the file;
        others: millimetres).
    cad_up : {`y`, `z`}, optional
        Axis of the CAD file that points up; default by its format (glTF: y).
    colour : {`incidence`, `residual`}
        Quantity shown by the colour of the lines of sight of a recording.

    Raises
    ------
    RecordError, InputError, NetworkError
        If the source is neither a recording nor a scenario, is malformed, or cannot be adjusted.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.view("paper-workshop")
    View: The paper's workshop: 5 stations, 28 targets; write_png(), write_html() or show()
    """
    check_argument_choice("cad_unit", cad_unit, tuple(UNIT_NAMES), allow_none=True)
    check_argument_choice("cad_up", cad_up, ("y", "z"), allow_none=True)
    check_argument_choice("colour", colour, ("incidence", "residual"))
    cad_path = None if cad is None else path_argument("cad", cad)
    require_extra(("pyvista", "trame_vtk"), "3D views", "view")
    workshop = _workshop_scene_of(source).with_sights_coloured_by(colour)
    return View(workshop if cad_path is None else workshop_with_cad(workshop, cad_path, cad_unit, cad_up))


def _workshop_scene_of(source: Recording | Scenario | str | Path) -> WorkshopScene:
    """Scene of a scenario or a recording; a name without a file is taken as a built-in scenario."""
    from ltsim.simulation.verbs import scenario  # loads the simulator, which no page needs

    if isinstance(source, Recording):
        return workshop_from_recording(source)
    if isinstance(source, Scenario):
        return workshop_from_scenario(source)
    path = path_of_file_or_built_in(source)
    is_scenario = (path.suffix == ".toml" and path.is_file()) or (path / "plan.json").is_file() or not path.exists()
    if is_scenario or str(source) in builtin_names():
        return workshop_from_scenario(scenario(source))
    return workshop_from_recording(read(path))


def report(
    folder: str | Path,
    *,
    recording: str | Path | None = None,
    title: str | None = None,
    about: ReportHeader | Mapping[str, str] | None = None,
    print_message: Callable[[str], None] = lambda words: None,
) -> Path:
    """Write `report.html` into a folder: one page that works offline.

    Parameters
    ----------
    folder : str or Path
        Folder of a recording, a calibration, a diagnosis, a campaign or a plan, or folder of such folders.
    recording : str or Path, optional
        Recording from which a calibration or diagnosis was computed, if it is not in the folder.
    title : str, optional
        Title of the page.
    about : mapping of str to str, optional
        Lines of the header: `instrument`, `date`, `operator`, `customer`; default the table ``[report]`` of the set-up.
    print_message : callable
        Callback with the error of each inner folder that cannot be read; the page shows the error too.

    Returns
    -------
    Path
        Path of the page.

    Raises
    ------
    RecordError
        If the folder contains no result, or a file is malformed. No page is written.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.write(recording, "my-recording")
    >>> lt.report("my-recording").name
    'report.html'
    """
    header = ReportHeader(**about) if isinstance(about, Mapping) else about
    recording_path = None if recording is None else Path(recording)
    target, content = (
        Path(folder) / REPORT_PAGE_FILE_NAME,
        document_of_folder(Path(folder), recording=recording_path, title=title, about=header),
    )
    for section in content.sections:
        if section.kind == UNREADABLE_SECTION_KIND:
            print_message(section.summary)
    write_text(target, page_html(content))
    return target
