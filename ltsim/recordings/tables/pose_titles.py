"""Titles and names that show the poses of a robot or of a moving target instead of a list of points."""

from collections.abc import Sequence
from itertools import pairwise

from ltsim.recordings.spreadsheets.header import normalised_title

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


def titles_of_joints_or_rotations(titles: Sequence[str]) -> list[str]:
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


def are_row_numbers(names: Sequence[str]) -> bool:
    """True if names are whole numbers that increase by one from row to row."""
    return all(name.isdigit() for name in names) and all(int(after) == int(name) + 1 for name, after in pairwise(names))
