"""Format: list of points (names with coordinates), which is recognised to be refused with the reason.

A table of the positions of a moving target (on a robot, a T-MAC), with or without the angles of the robot, looks like a
list of points, too.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from ltsim.core.errors import RecordError
from ltsim.core.notation import names_text
from ltsim.recordings.coordinates import is_point_list, read_points
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.recording import Recording
from ltsim.recordings.spreadsheets.cells import has_time_of_day, is_numeric
from ltsim.recordings.spreadsheets.header import normalised_title
from ltsim.recordings.tables import reader as tables
from ltsim.recordings.tables.missing_names import (
    MOVING_TARGET_TEXT,
    STATION_OF_POSITIONS_ADVICE,
    UnnamedTargetsError,
    UnrecognisedStationColumnError,
)

MIN_ROWS_SHOWING_MOVING_TARGET = 2
"""Smallest number of rows, with a name used before and different coordinates, that shows a moving target instead of a
list of points. The number must also be at least the number of different names."""
TRIAL_STATION_NAME = "S1"
"""Station name for a test whether a list of coordinates can be read as the positions that one station measured."""
MAX_REPEATED_POINT_DISTANCE_M = 1e-3
"""Largest distance [m] between repeated measurements of one point, given as rows with one name; rows with a larger
distance contradict each other."""
MIN_ADDITIONAL_COLUMNS_OF_POSES = 3
"""Smallest number of columns besides positions, such as angles of joints or of a rotation, that shows poses of a robot
instead of a list of points."""
JOINT_WORDS = ("j", "joint", "a", "axis", "achse", "q", "theta", "t", "ax", "gelenk", "e")
"""Words that denote a joint of a robot, before the number of the joint."""
ROTATION_TITLES = (
    "rx ry rz",
    "roll pitch yaw",
    "a b c",
    "w p r",
    "qx qy qz",
    "q1 q2 q3",
    "rotx roty rotz",
    "anglex angley anglez",
)
"""Titles, separated by blanks, of the three numbers of a rotation."""


def recognises(path: Path, file_beginning: str) -> bool:
    """True if the file is a list of points (names with coordinates), not a recording."""
    return path.is_file() and not file_beginning.startswith(("<", "PK")) and is_point_list(file_beginning)


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """RecordError for a list of points, which is not a recording; the function always raises an error."""
    point_list = read_points(path, refuses_contradictions=False)
    n_points, n_repeated = len(point_list.names), point_list.n_contradictory_rows
    if n_repeated:
        for station in (None, TRIAL_STATION_NAME):
            try:
                tables.read(path, replace(hints, station=station))
            except (UnrecognisedStationColumnError, UnnamedTargetsError):
                raise
            except RecordError:
                pass  # it is no table of several set-ups
    names = "one name" if n_points == 1 else f"{n_points} names"
    titles = list(point_list.additional_columns)
    is_numbered = _are_row_numbers(point_list.names) and len(titles) >= MIN_ADDITIONAL_COLUMNS_OF_POSES
    if all(has_time_of_day(name) or (is_numeric(name) and not name.isdigit()) for name in point_list.names) or (
        is_numbered
    ):
        message = f"this is a table of {n_points + n_repeated} positions without point names, {MOVING_TARGET_TEXT}; it "
        message += "is not a list of points"
    elif pose_titles := _titles_of_joints_or_rotations(titles):
        first_name, titles_text = safe_excerpt(point_list.names[0]), names_text([*map(safe_excerpt, pose_titles)])
        message = f"this is a table of {n_points + n_repeated} poses ('{first_name}') with the angles of joints or "
        message += f"rotations {titles_text}, {MOVING_TARGET_TEXT}; it is not a list of points"
    elif n_repeated and point_list.max_repeated_point_distance_m < MAX_REPEATED_POINT_DISTANCE_M:
        message = f"this is a list of {n_points} points in {n_points + n_repeated} rows, without instrument readings"
    elif n_repeated >= max(n_points, MIN_ROWS_SHOWING_MOVING_TARGET):
        rows = f"{n_points + n_repeated} positions under {names} ('{point_list.names[0]}')"
        message = f"this is a table of {rows}, {MOVING_TARGET_TEXT}; it is not a list of points"
    else:
        message = f"this is a list of {n_points} points without instrument readings (nominal or reference coordinates)"
    raise RecordError(f"{message} ({STATION_OF_POSITIONS_ADVICE})", file=path)


def _titles_of_joints_or_rotations(titles: Sequence[str]) -> list[str]:
    """Titles among `titles` that denote joints (`J1`, `Axis 2`) or a rotation (`Rx`, `roll`); empty for fewer than 3.

    Units in brackets are ignored.
    """
    words = [normalised_title(title.partition("[")[0].partition("(")[0].removesuffix("_deg")) for title in titles]
    joints = [title for title, word in zip(titles, words, strict=True) if _is_joint(word)]
    if len(joints) >= MIN_ADDITIONAL_COLUMNS_OF_POSES:
        return joints
    for names in ROTATION_TITLES:
        if {*names.split()} <= {*words}:
            return [title for title, word in zip(titles, words, strict=True) if word in names.split()]
    return []


def _is_joint(word: str) -> bool:
    """True if a title without blanks and capital letters is a word for a joint with one digit."""
    return word[-1:].isdigit() and word[:-1] in JOINT_WORDS


def _are_row_numbers(names: Sequence[str]) -> bool:
    """True if names are whole numbers that increase by one from row to row."""
    return all(name.isdigit() for name in names) and all(int(after) == int(name) + 1 for name, after in pairwise(names))
