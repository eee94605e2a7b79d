"""Size limits of input files and networks, checked before memory is allocated for their content.

With these limits, reading a file of up to 32 MiB takes at most 500 MB of memory and 30 s of processor time
(`tests/recordings/test_limits.py` measures both at the limits of TOML, XML and JSON). A monitoring recording of 100,000
pointings can be read, but has to be thinned before its adjustment (`ltsim convert --every`).
"""

import os
import re

from ltsim.core.errors import ModelError, RecordError

BYTES_PER_MIB = 1024 * 1024
"""Number of bytes of a mebibyte."""

MAX_FILE_BYTES = 32 * BYTES_PER_MIB
"""Largest size [bytes] of an input file. A table of 500,000 pointings has 25 MiB."""
MAX_TEXT_LINES = 500_000
"""Largest number of lines of a text file, and of rows of all sheets of a workbook together. A pointing takes 600 bytes
while it is read."""
MAX_LGC_LINES = 200_000
"""Largest number of lines of an LGC file; a line with a polar observation takes 1.9 kB while it is read."""
MAX_FIELD_BOOK_POINTINGS = 300_000
"""Largest number of pointings in a field book of a total station; a pointing takes 1.3 kB while it is read."""
MAX_LINE_CHARACTERS = 20_000
"""Largest number of characters in a line of a file, enough for a header of `MAX_TABLE_COLUMNS` names with 40 characters
each."""
MAX_TABLE_COLUMNS = 500
"""Largest number of columns in a table."""
MAX_TABLE_HEADERS = 10_000
"""Largest number of header lines in a table that repeats its header for each set-up or page. The rows after each header
are converted together, which takes a millisecond."""
MAX_WORKBOOK_CELLS = 3_000_000
"""Largest number of cells in all sheets of a workbook together, 80 bytes each."""

MAX_ADJUSTED_POINTINGS = 50_000
"""Largest number of pointings of a network that is adjusted or checked. A pointing takes 4 to 7 kB and 0.5 ms. The
imported libraries take 130 MB, or 480 MB with pictures."""
MAX_CALIBRATED_POINTINGS = 30_000
"""Largest number of pointings of a network that is calibrated. It is smaller than `MAX_ADJUSTED_POINTINGS`, because
proposals for further measurements are evaluated on networks up to three times as large."""
MAX_ADJUSTED_TARGETS = 6_000
"""Largest number of targets of a network that is adjusted or checked; time and memory grow with the square of this
number. An adjustment of two set-ups takes 19 s and 436 MB with 6,000 targets, and 44 s and 970 MB with 10,000. The
largest measured networks have 1,000 targets."""
MAX_CALIBRATED_TARGETS = 2_500
"""Largest number of targets of a network that is calibrated. A calibration with 2,500 targets takes 9 s and 400 MB,
with 10,000 targets 104 s and 4.2 GB."""
MAX_DIAGNOSED_TARGETS = 1_500
"""Largest number of targets of a network that is diagnosed. A diagnosis with 1,500 targets takes 60 s and 0.8 GB, with
3,000 targets 148 s and 2.1 GB."""
MAX_NETWORK_SETUPS = 500
"""Largest number of set-ups of a network that is adjusted, checked, calibrated or diagnosed. Memory and time grow with
the number of pairs of set-up and target, and of pairs of set-ups. The largest measured networks have hundreds of
set-ups."""
MAX_DIAGNOSED_POINTINGS = 8_000
"""Largest number of pointings of a network that is diagnosed. The diagnosis of a recording that contradicts its model
takes 24 s of processor time and 310 MB with 2,000 pointings, and 115 s and 0.85 GB with 8,000. A ring of 210 set-ups
(3,360 pointings) takes 30 to 95 s and 450 to 530 MB. Other processes ran during these measurements.
"""
MAX_SIMULATED_POINTINGS = 300_000
"""Largest number of pointings of a simulated recording; each takes 1 kB and 30 us."""
MAX_CAMPAIGN_POINTINGS = 15_000
"""Largest number of pointings of a network of a campaign. A pointing takes 6 kB, most of it for the derivatives of its
readings and for the full solver, which repeats some trials for verification. The imported libraries take 400 MB."""
MAX_CAMPAIGN_UNKNOWNS = 2_000
"""Largest number of unknowns of a network in a campaign: six for each station and three for each target. Three matrices
of this size take 100 MB."""
POINTINGS_LIMIT_VARIABLE = "LTSIM_MAX_POINTINGS"
"""Name of the environment variable that raises the limits of pointings, set-ups and targets for all commands, on
machines with more memory."""

MAX_TOML_BYTES = 8 * BYTES_PER_MIB
"""Largest size [bytes] of a TOML file; the parser, written in Python, reads 1 MiB in a second."""
MAX_TOML_DEPTH = 32
"""Largest nesting depth of tables, arrays and dotted keys in a TOML file; the deepest file of ltsim has 6. Time and
memory of the parser grow with the square of the depth.
"""
MAX_TOML_KEYS = 100_000
"""Largest number of keys and table headers in a TOML file; each part of a dotted key counts. The limit permits 20,000
points with five keys each. A table takes 2 kB of memory."""
MAX_TOML_WORD_CHARACTERS = 1_000
"""Largest number of characters of a key without quotes, a number or a date in a TOML file; the longest number that is
read has 40. The parser takes 130 bytes for each digit of a number.
"""
MAX_TOML_TEXT_CHARACTERS = 10_000
"""Largest number of characters of a text between quotes in a TOML file. Titles and comments are copied into results,
whose texts have at most `MAX_RESULT_TEXT_CHARACTERS`.
"""
MAX_TOML_VALUES = 400_000
"""Largest number of keys, tables, arrays and commas in a TOML file. The limit permits 20,000 points with three
coordinates and a covariance matrix each."""

MAX_JSON_VALUES = 1_500_000
"""Largest number of commas and opening brackets in a JSON file, which is an upper bound of the number of values. An
empty object with its comma has three characters and takes 64 bytes of memory."""

MAX_RESULT_LIST_ENTRIES = 10_000
"""Largest number of entries in a list of a result file. Such lists have one entry per parameter, target or test; values
of pointings are in tables. An entry takes 1 to 2 kB in a report."""
MAX_RESULT_TEXTS = 100_000
"""Largest number of texts, lists and objects together in a result file; a plan of 1,000 points that 40 stations measure
has 50,000. Each takes 270 bytes in a report, whose libraries take 470 MB with pictures, measured with a plan.
"""
MAX_RESULT_TEXT_CHARACTERS = 20_000
"""Largest number of characters of a text in a result file; the longest that ltsim writes has 1,000, without texts of
the user."""
MAX_RESULT_MEAN_TEXT_CHARACTERS = 10
"""Largest mean number of characters of the texts in a result file, if the file has the largest permitted number of
texts. The product with `MAX_RESULT_TEXTS` is the largest number of characters of all texts together."""

MAX_UNCERTAINTY_TASK_RESULTS = 1_000
"""Largest number of results of all tasks together in one evaluation of uncertainty. The result file contains the
correlation of each pair of results and may have at most `MAX_JSON_VALUES` values. The 10,000 Monte Carlo trials of a
result take 80 kB, and are in memory four times."""
MAX_ADDITIONAL_EFFECTS = 200
"""Largest number of effects in an uncertainty budget (type B), and of effects that a calibration method of a campaign
estimates. Each effect is linearised for all pointings. The catalogue of effects has 60.
"""
MAX_EFFECTS_TIMES_POINTINGS = 60_000
"""Largest product of the numbers of effects that are estimated together and of pointings. In a calibration an effect
takes 430 bytes for each pointing, and in a campaign 800: 7 effects of 14,000 pointings take 540 MB together."""
MAX_UNCERTAINTY_TRIALS_TIMES_RESULTS = 20_000_000
"""Largest product of the number of Monte Carlo trials and the number of results in an evaluation of uncertainty. One
trial of one result takes 16 bytes."""

MAX_READ_SHARD_ROWS = 1_000_000
"""Largest number of rows in a file of campaign rows (shard) that is read; a campaign writes at most 65,536. Equal rows
take no space in the file, and 200 bytes each in memory."""
MAX_DATABASE_MEMORY_BYTES = 250 * BYTES_PER_MIB
"""Largest memory [bytes] of the database that reads the rows of a campaign. The limit grows in proportion to the total
size of the files of rows if this is larger than `MAX_FILE_BYTES`."""

MAX_FIGURE_ITEMS = 1_000
"""Largest number of points, bars or curves in a figure of a report; each takes 5 ms and 0.1 MB. A reader cannot
distinguish more of them."""

MAX_XML_TAGS = 600_000
"""Largest number of tags in an XML file; each element has one or two and takes 400 bytes."""
MAX_XML_ATTRIBUTES = 1_000_000
"""Largest number of equals signs in an XML file, an upper bound of the number of attributes of 150 bytes each."""
MAX_XML_DEPTH = 64
"""Largest nesting depth of XML elements; the deepest format that is read has 8."""
MAX_TAG_ATTRIBUTES = 1_000
"""Largest number of attributes in one XML tag; the parser holds all of them before it returns the tag."""

MAX_COVARIANCE_VALUES = 1_000_000
"""Largest number of values of a covariance matrix in an XML file: the upper triangle of 1,400 coordinates. A value
takes 120 bytes while it is read.
"""
MAX_JOINT_COVARIANCE_COORDINATES = 1_500
"""Largest number of coordinates with a joint covariance matrix, for example of compared epochs. A comparison of 500
points that all moved takes 14 s and 420 MB, of 1,000 points more than two minutes and 1.2 GB.
"""

MAX_WORKBOOK_BYTES = 16 * BYTES_PER_MIB
"""Largest size [bytes] of all unpacked parts of a workbook, checked by their headers and again while unpacking. A cell
takes 30 bytes and 30 us of reading time.
"""
MAX_WORKBOOK_ELEMENTS = 1_200_000
"""Largest number of XML elements in a part of a workbook: 600,000 cells of 27 bytes each, which fill
`MAX_WORKBOOK_BYTES`.
"""
MAX_WORKBOOK_ROW_CELLS = 16_384
"""Largest number of cells in a row of a workbook, as many as spreadsheets have columns. A cell takes 350 bytes while
its row is read.
"""
MAX_WORKBOOK_PARTS = 1_000
"""Largest number of parts in a workbook archive."""
MAX_WORKBOOK_SHEETS = 200
"""Largest number of sheets in a workbook."""

MAX_CAD_BYTES = 512 * BYTES_PER_MIB
"""Largest size [bytes] of a CAD file."""
MAX_CAD_MEMORY_BYTES = 250 * BYTES_PER_MIB
"""Largest memory [bytes], in addition to 125 MB of libraries, of the process that reads a CAD file. The limit grows in
proportion to the size of a file larger than `MAX_FILE_BYTES`. The process that waits for the result takes 110 MB."""
MAX_CAD_SECONDS = 25
"""Largest processor time [s] of the process that reads a CAD file. The limit grows in proportion to the size of a file
larger than `MAX_FILE_BYTES`."""
MAX_IN_PROCESS_CAD_BYTES = BYTES_PER_MIB // 2
"""Largest size [bytes] of an OBJ or PLY file that is read without a separate process. A polygon with many corners takes
360 bytes of memory for each byte of the file.
"""
MAX_FLOOR_PLAN_ELEMENTS = 200
"""Largest number of floor areas, of holes in one area, of keep-out areas, and of doors, each counted separately. Each
is compared with all positions of tripods. A hall has tens of them."""
MAX_OBSTACLE_TRIANGLES = 200_000
"""Largest number of triangles in a CAD file, counted for each instance of a part. A triangle takes 700 bytes while it
is read, and 1,500 bytes as part of an obstacle in a hall."""


def overridable_limit(default_limit: int) -> int:
    """Limit of a number of pointings, set-ups or targets: `default_limit`, or a larger limit from LTSIM_MAX_POINTINGS.

    ModelError is raised if this environment variable is not a whole number.
    """
    text = os.environ.get(POINTINGS_LIMIT_VARIABLE, "").strip()
    if text and not re.fullmatch("[0-9]{1,9}", text):
        raise ModelError(
            f"the environment variable {POINTINGS_LIMIT_VARIABLE} is {text!r}; expected a whole number of pointings"
        )
    return max(default_limit, int(text or 0))


def require_few_effects(n_effects: int, n_pointings: int) -> None:
    """Check that the estimation of `n_effects` effects from `n_pointings` pointings fits in memory.

    ModelError is raised if their product exceeds `MAX_EFFECTS_TIMES_POINTINGS`.
    """
    if n_effects * n_pointings > overridable_limit(MAX_EFFECTS_TIMES_POINTINGS):
        most = overridable_limit(MAX_EFFECTS_TIMES_POINTINGS) // n_pointings
        raise ModelError(
            f"{n_effects} effects of {n_pointings} pointings are estimated together, expected at most {most}: estimate "
            f"fewer effects, or on a machine with more memory set the environment variable {POINTINGS_LIMIT_VARIABLE} "
            f"to {n_effects * n_pointings}"
        )


def require_small_joint_covariance(n_coordinates: int, file: object) -> None:
    """Check that a joint covariance matrix of `n_coordinates` coordinates fits in memory.

    RecordError, which names `file`, is raised for more than `MAX_JOINT_COVARIANCE_COORDINATES` coordinates.
    """
    if n_coordinates > (most := overridable_limit(MAX_JOINT_COVARIANCE_COORDINATES)):
        expected = (
            f"expected at most {most}: leave out points, or on a machine with more memory set the environment variable "
            f"{POINTINGS_LIMIT_VARIABLE} to {n_coordinates}"
        )
        raise RecordError(f"{n_coordinates} coordinates with a joint covariance matrix, {expected}", file=file)
