"""Titles of coordinates with a common word, such as `Tracker X`, `Tracker Y`, `Tracker Z`."""

from collections.abc import Sequence

AXIS_LETTERS = "xyz"
"""Letters of the axes, with which titles of coordinates begin or end."""
MIN_COMMON_WORD_LENGTH = 3
"""Smallest number of letters of the common word. One or two letters denote other quantities, such as rotations
and quaternions."""
WORDS_OF_OTHER_VECTORS = (
    "rot rotation angle ang euler quat quaternion vel velocity speed acc accel acceleration gyro force torque moment "
    "sigma std stddev sdev err error dev deviation diff difference delta unc uncertainty normal norm dir direction "
    "nom nominal soll cad design ref reference scale mag temp offset drehung winkel abweichung"
)
"""Words, separated by blanks, that denote rotations, deviations, nominal values and other vectors."""


def axes_of_titles_with_common_word(titles: Sequence[str]) -> dict[int, str]:
    """Axis (`x`, `y` or `z`), by position, of three titles with a common word before or after the letter of the axis.

    `titles` are in the form of `normalised_title`. The result is empty if no word, or more than one, has three axes.
    """
    positions_by_word: dict[tuple[str, bool], dict[str, int]] = {}
    for position, title in enumerate(titles):
        for word, letter, is_prefix in ((title[:-1], title[-1:], True), (title[1:], title[:1], False)):
            is_usable = len(word) >= MIN_COMMON_WORD_LENGTH and word not in WORDS_OF_OTHER_VECTORS.split()
            if is_usable and letter and letter in AXIS_LETTERS:
                positions_by_word.setdefault((word, is_prefix), {}).setdefault(letter, position)
    complete = [axes for axes in positions_by_word.values() if len(axes) == len(AXIS_LETTERS)]
    return {position: axis for axis, position in complete[0].items()} if len(complete) == 1 else {}
