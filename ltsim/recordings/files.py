"""Reading of files up to a size limit, checks of numbers and names in them, and writing without incomplete files."""

import codecs
import re
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ltsim.core.errors import RecordError
from ltsim.core.limits import BYTES_PER_MIB, MAX_FILE_BYTES, MAX_LINE_CHARACTERS, MAX_TEXT_LINES
from ltsim.core.storage import is_device_or_pipe, open_for_reading, write_files, write_to_device

MAX_RECORDING_NAME_LENGTH = 100
"""Largest permitted number of characters in the name of a station, target or instrument."""
MAX_NUMBER_TEXT_LENGTH = 40
"""Largest number of characters of a cell that is read as a number."""
MAX_CELL_TEXT_LENGTH = 500
"""Largest permitted number of characters in a text, such as a cell of an additional column."""
MAX_RECORDING_TITLE_LENGTH = 120
"""Number of characters to which the title in a file of another program is shortened."""
UTF8_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
"""Byte-order mark of UTF-8."""
UTF16_BYTE_ORDER_MARKS = (b"\xff\xfe", b"\xfe\xff")
"""Byte-order marks of UTF-16, little-endian and big-endian."""
_UNDEFINED_WINDOWS_1252_BYTES = frozenset(b"\x81\x8d\x8f\x90\x9d")  # bytes without a meaning in Windows-1252
"""Bytes that represent no character in the encoding Windows-1252."""
NUMBER_PATTERN = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)
"""Pattern of a decimal number in ASCII, with or without exponent."""
_NOT_FINITE_PATTERN = re.compile(r"[+-]?(?:nan|inf|infinity)", re.IGNORECASE)
"""Pattern of texts for NaN and infinity."""
_FORBIDDEN_CHARACTERS = re.compile(r"[<>/\\]")
r"""Pattern of the characters < > / \, which names must not contain, because they are used in markup and paths."""


def read_bytes(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Content of a file of at most `max_bytes` bytes.

    Raises RecordError for a missing, unreadable, empty or too large file, and for a folder, pipe or device.
    """
    try:
        with open_for_reading(path) as stream:
            content = stream.read(max_bytes + 1)
    except FileNotFoundError:
        raise RecordError("there is no such file", file=path) from None
    except IsADirectoryError:
        raise RecordError("the path is a folder, expected a file", file=path) from None
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or "not a usable path"
        raise RecordError(f"the file cannot be read ({reason})", file=path) from None
    if len(content) > max_bytes:
        raise RecordError(f"the file is larger than {max_bytes // BYTES_PER_MIB} MiB, the limit for reading", file=path)
    if not content or content.isspace():
        raise RecordError("is empty", file=path)
    return content


def decode_file_beginning(content: bytes) -> str:
    """Text of the first bytes of a file, in UTF-16 (recognised by its byte-order mark), UTF-8 or else Latin-1.

    An incomplete character at the end is omitted.
    """
    if content.startswith(UTF16_BYTE_ORDER_MARKS):
        return content.decode("utf-16", errors="replace")
    try:
        return codecs.getincrementaldecoder("utf-8-sig")().decode(content)
    except UnicodeDecodeError:
        return content.removeprefix(UTF8_BYTE_ORDER_MARK).decode("latin-1")


def read_file_beginning(path: Path, n_bytes: int) -> str:
    """Text of the first `n_bytes` bytes of a file, decoded by `decode_file_beginning`.

    Raises RecordError for a file that cannot be read, and for a pipe or device.
    """
    try:
        with open_for_reading(path) as stream:
            return decode_file_beginning(stream.read(n_bytes))
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or "not a usable path"
        raise RecordError(f"the file cannot be read ({reason})", file=path) from None


def read_text(path: Path, *, replaces_undecodable: bool = False, max_bytes: int = MAX_FILE_BYTES) -> str:
    """Text of a file of at most `max_bytes` bytes, in UTF-8 or UTF-16.

    With `replaces_undecodable`, a file in any other encoding is read as Windows-1252; otherwise RecordError is raised.
    """
    content = read_bytes(path, max_bytes)
    if content.startswith(UTF16_BYTE_ORDER_MARKS):
        content = decode_file_beginning(content).encode()
    elif b"\x00" in content[1:2] and replaces_undecodable:
        content = content.decode("utf-16-le", errors="replace").encode()
    if b"\x00" in content:
        raise RecordError(
            "the file contains binary data, or UTF-16 without a byte-order mark; expected UTF-8 text", file=path
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        if replaces_undecodable:
            return content.decode("latin-1" if _UNDEFINED_WINDOWS_1252_BYTES & {*content} else "cp1252")
        line = content[: problem.start].count(b"\n") + 1
        raise RecordError(f"the file is not UTF-8 text (first in line {line}); save it as UTF-8", file=path) from None


def read_lines(path: Path, *, replaces_undecodable: bool = False, max_lines: int = MAX_TEXT_LINES) -> list[str]:
    """Lines of a text file without line breaks, which may be those of Unix, Windows or old Macintosh.

    With `replaces_undecodable`, a file that is neither UTF-8 nor UTF-16 is read as Windows-1252. Raises RecordError for
    more than `max_lines` lines, and for a line of more than `MAX_LINE_CHARACTERS` characters.
    """
    text = with_unix_line_ends(read_text(path, replaces_undecodable=replaces_undecodable))
    if text.count("\n") > max_lines:
        raise RecordError(f"the file has more than {max_lines} lines, the limit for reading", file=path)
    lines = text.split("\n")
    for i, line in enumerate(lines):
        if len(line) > MAX_LINE_CHARACTERS:
            raise RecordError(f"line {i + 1} is longer than {MAX_LINE_CHARACTERS} characters", file=path)
    return lines


def with_unix_line_ends(text: str) -> str:
    """Copy of `text` with Unix line breaks."""
    return re.sub("(?<!\r)\r++\n|\r", "\n", text) if "\r" in text else text  # one look at each of many returns


def is_number(text: str) -> bool:
    """True if `text` is a decimal number in ASCII."""
    return len(text) <= MAX_NUMBER_TEXT_LENGTH and NUMBER_PATTERN.fullmatch(text) is not None


def is_not_finite(text: str) -> bool:
    """True if `text` is a spelling of NaN or infinity."""
    return len(text) <= 10 and _NOT_FINITE_PATTERN.fullmatch(text) is not None


def safe_excerpt(text: str, max_length: int = 40) -> str:
    """Beginning of `text` for a message of one line: at most `max_length` characters, unprintable ones replaced."""
    printable_text = "".join(c if c.isprintable() else "?" for c in text[: max_length + 1])
    return printable_text if len(printable_text) <= max_length else printable_text[:max_length] + "..."


@dataclass(frozen=True, slots=True)
class SourceLocation:
    """Location in a file: its methods check texts read there, and their errors name file, row and column."""

    file: object = None
    row: int | None = None
    column: str | None = None

    def error(self, message: str, column: str | None = None) -> RecordError:
        """RecordError with `message` that names this location; the caller raises it."""
        return RecordError(message, file=self.file, row=self.row, column=self.column if column is None else column)

    def parse_number(
        self, text: str, column: str | None = None, *, limit: float = 1e12, allows_decimal_comma: bool = False
    ) -> float:
        """Number in `text`, at most `limit` in magnitude; `allows_decimal_comma` also permits a decimal comma.

        Raises RecordError for any other text, including NaN, infinities and digits of other scripts.
        """
        text = text.strip().replace(",", ".", 1) if allows_decimal_comma else text.strip()
        if not is_number(text):
            expectation = "expected a finite number" if is_not_finite(text) else "expected a number"
            hint = ", with a point instead of a comma" if is_number(text.replace(",", ".", 1)) else ""
            raise self.error(f"found '{safe_excerpt(text)}', {expectation}{hint}", column)
        value = float(text)
        if not abs(value) <= limit:
            raise self.error(f"found {safe_excerpt(text)}, expected a number of at most {limit:g} in magnitude", column)
        return value

    def checked_name(self, name: str, kind: str, column: str | None = None) -> str:
        """Unchanged `name`, checked as the name of a station, target or instrument (`kind`); raises RecordError.

        Names occur in tables, reports and paths. Therefore control characters, markup and path separators are refused.
        """
        if not name or name != name.strip():
            what = "is empty" if not name.strip() else f"'{safe_excerpt(name)}' begins or ends with a space"
            raise self.error(f"the name of a {kind} {what}", column)
        reason = ""
        if len(name) > MAX_RECORDING_NAME_LENGTH:
            reason = f"is longer than {MAX_RECORDING_NAME_LENGTH} characters"
        elif not name.isprintable():
            reason = "holds a control character"
        elif forbidden := _FORBIDDEN_CHARACTERS.search(name):
            reason = f"holds '{forbidden.group()}'; a name may not contain < > / or \\"
        elif name in (".", ".."):
            reason = "is the name of a folder"
        if reason:
            raise self.error(f"the name of a {kind}, '{safe_excerpt(name)}', {reason}", column)
        return name

    def checked_text(self, text: str, column: str | None = None) -> str:
        """Unchanged `text`, checked to be one line of at most `MAX_CELL_TEXT_LENGTH` characters; raises RecordError.

        Control characters and markup are refused.
        """
        has_markup = "<" in text or ">" in text or not text.isprintable()
        if len(text) > MAX_CELL_TEXT_LENGTH or has_markup:
            reason = (
                "contains control characters or markup"
                if has_markup
                else f"is longer than {MAX_CELL_TEXT_LENGTH} characters"
            )
            raise self.error(f"the text '{safe_excerpt(text)}' {reason}", column)
        return text


def parse_comma_number(text: str, *, file: object, row: int | None = None, column: str | None = None) -> float:
    """Finite number in a text with a decimal point or comma; `file`, `row` and `column` are named in errors."""
    return SourceLocation(file, row, column).parse_number(text, allows_decimal_comma=True)


def single_line_title(text: str) -> str:
    """Title in a file of another program, shortened to one line of `MAX_RECORDING_TITLE_LENGTH` characters."""
    beginning = text.lstrip()[: 10 * MAX_RECORDING_TITLE_LENGTH]  # a description of 30 MB would be split into its words
    line = textwrap.shorten(beginning, MAX_RECORDING_TITLE_LENGTH, placeholder=" ...")
    return "".join(c for c in line.replace("<", "(").replace(">", ")") if c.isprintable())


def write_texts(folder: Path, texts: Mapping[str, str | bytes]) -> None:
    """Writing of files into `folder`, all or none; `texts` are the contents by file name, which may include subfolders.

    Raises RecordError if the folder cannot be created or written to, or if a link leads out of the folder.
    """
    with _raise_writing_errors_as_record_errors(folder):
        write_files(folder, {name: _utf8_bytes(text) for name, text in texts.items()})


def write_text(path: Path, text: str | bytes) -> None:
    """Writing of one file without an incomplete intermediate state; a pipe or device is written directly.

    A temporary file is written and renamed. Raises RecordError if the file cannot be written, or a link leads out of
    its folder.
    """
    if is_device_or_pipe(path) and not path.is_symlink():
        with _raise_writing_errors_as_record_errors(path):
            write_to_device(path, _utf8_bytes(text))
    else:
        write_texts(path.parent, {path.name: text})


def _utf8_bytes(text: str | bytes) -> bytes:
    """Text encoded in UTF-8; bytes remain unchanged."""
    return text.encode() if isinstance(text, str) else text


@contextmanager
def _raise_writing_errors_as_record_errors(path: Path) -> Iterator[None]:
    """Context manager that raises errors of writing to `path` as RecordError."""
    try:
        yield
    except (OSError, UnicodeEncodeError) as problem:
        reason = getattr(problem, "strerror", None) or "text that UTF-8 cannot represent"
        raise RecordError(f"the file cannot be written ({reason})", file=path) from None
