"""Size limits of input files, checked before anything is built from a file.

Together they keep the reading of any file of up to 32 MiB within 500 MB of memory and 30 s of processor time
(`tests/recordings/test_limits.py` measures both at the limits of TOML, XML and JSON). A monitoring of 100,000 pointings
passes all of them.
"""

MIB = 1024 * 1024

FILE_BYTES = 32 * MIB
"""[bytes] Size of a file; a table of 500,000 pointings has 25 MiB."""
LINES = 500_000
"""Lines of a text file, rows of all sheets of a workbook together: a pointing takes 600 bytes while it is read."""
LINE_CHARACTERS = 20_000
"""Characters of a line: a header of `FIELDS` names of 40 characters."""
FIELDS = 500
"""Columns of a table."""
HEADERS = 10_000
"""Headers of a table, one for each set-up or page: rows between two are converted together, in a millisecond."""
CELLS = 3_000_000
"""Cells of all sheets of a workbook together: 80 bytes each."""

ADJUSTED_POINTINGS = 60_000
"""Pointings of a network that is adjusted or checked: a pointing takes 5 kB and 0.5 ms, the libraries 130 MB, or with
pictures 480 MB."""
CALIBRATED_POINTINGS = 35_000
"""Pointings of a network that is calibrated: what else to measure is tried on networks up to three times as large."""
DIAGNOSED_POINTINGS = 8_000
"""Pointings of a network that is diagnosed, in half a minute: each meets the candidate causes, which takes 170 kB."""

TOML_BYTES = 8 * MIB
"""[bytes] Size of a TOML file: the parser, written in Python, reads 1 MiB in a second."""
TOML_DEPTH = 32
"""Tables, arrays and parts of dotted keys inside each other; the deepest file of ltsim has 6. Time and memory of the
parser grow with the square of the depth."""
TOML_KEYS = 100_000
"""Keys and headers of tables: 20,000 points with five keys each. A table takes 2 kB."""
TOML_VALUES = 400_000
"""Keys, tables, arrays and commas together: 20,000 points with three coordinates and a covariance each."""

JSON_VALUES = 1_500_000
"""Commas and opening brackets of a JSON file, at most as many values as that: an empty object takes 64 bytes for 3."""

XML_TAGS = 600_000
"""Tags of an XML file, of which every element has one or two: an element takes 400 bytes."""
XML_ATTRIBUTES = 1_000_000
"""Equals signs of an XML file, at least one for each attribute: an attribute takes 150 bytes."""
XML_DEPTH = 64
"""Elements inside each other; the deepest format that is read has 8."""
TAG_ATTRIBUTES = 1_000
"""Attributes of one tag, all of which the parser holds before it gives the tag."""

WORKBOOK_BYTES = 16 * MIB
"""[bytes] Size of all unpacked parts of a workbook, checked by their headers and again while unpacking: a cell
takes 30 bytes there and 30 us of all that reads it."""
WORKBOOK_PARTS = 1_000
"""Parts of a workbook."""
SHEETS = 200
"""Sheets of a workbook; several may name the same part, which is then read several times."""

CAD_BYTES = 512 * MIB
"""[bytes] Size of a CAD file."""
CAD_MEMORY = 250 * MIB
"""[bytes] Memory that the process that reads a CAD file takes beyond its libraries, 125 MB; in proportion more
for a file of more than `FILE_BYTES`. The process that waits for it takes 110 MB."""
CAD_SECONDS = 25
"""[s] Processor time of that process, likewise."""
SMALL_CAD_BYTES = MIB // 2
"""[bytes] Size up to which an OBJ or PLY file is read without a process of its own: a polygon of many corners makes 360
bytes of each byte."""
TRIANGLES = 200_000
"""Triangles of a CAD file, those of each instance counted: 700 bytes each while they are read, 1,500 in a hall whose
sights they may hide."""
