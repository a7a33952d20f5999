"""What every text format must be before it is parsed: UTF-8, without NUL, with lines of bounded length."""

from __future__ import annotations

import codecs
from typing import Final

import numpy as np

from magcal_core.errors import EncodingError, TelemetryFormatError, TooManyRowsError
from magcal_core.foreign_files import binary_file, web_page

MAX_LINE_BYTES: Final = 4096
"""Longest line of a table."""
MAX_COMMENT_BYTES: Final = 1 << 20
"""Longest line behind ``#``: a HAPI server may write all its header, some hundred parameters, on one."""
MAX_ROWS: Final = 20_000_000
"""Most rows of one table."""

_BLOCK_BYTES: Final = MAX_LINE_BYTES // 2
"""A line that is too long covers at least one aligned block of half its length, and that block has no line end."""
_BLOCKS_AT_ONCE: Final = 128

_FOREIGN_MARKS: Final = {
    codecs.BOM_UTF32_LE: "UTF-32",
    codecs.BOM_UTF32_BE: "UTF-32",
    codecs.BOM_UTF16_LE: "UTF-16",
    codecs.BOM_UTF16_BE: "UTF-16",
}


def refuse_other_files(data: bytes) -> None:
    """Refuse what is no table but a file of another kind, or a web page.

    Raises
    ------
    TelemetryFormatError
        It is; the message names it.
    """
    binary = binary_file(data)
    if binary is not None:
        raise TelemetryFormatError(f"this is {binary}: no text, and no table that is read")
    page = web_page(data)
    if page is not None:
        raise TelemetryFormatError(f"this is {page}, not a table: a page for people, or a server's error or login")


def checked_text(data: bytes) -> bytes:
    """Return ``data`` without its byte order mark, known to be UTF-8 without NUL.

    Raises
    ------
    EncodingError
        The text is not UTF-8 or has a NUL; the message has the byte offset.
    """
    for mark, name in _FOREIGN_MARKS.items():
        if data.startswith(mark):
            raise EncodingError(f"the text is {name} (byte offset 0); send UTF-8")
    # numpy, unlike bytes, lets other threads run while it looks through a long text.
    codes = np.frombuffer(data, np.uint8)
    if codes.min(initial=1) == 0:
        raise EncodingError(f"the text has a NUL at byte offset {data.find(bytes(1))}; send UTF-8 text")
    if codes.max(initial=0) > 127:
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            raise EncodingError(f"the text is not UTF-8 at byte offset {error.start}") from error
    return data.removeprefix(codecs.BOM_UTF8)


def check_lines(text: bytes, *, max_rows: int = MAX_ROWS) -> None:
    """Refuse a text with a line or a number of lines past the limits.

    Raises
    ------
    TelemetryFormatError
        A line is longer than `MAX_LINE_BYTES`, or one behind ``#`` than `MAX_COMMENT_BYTES`.
    TooManyRowsError
        There are more than ``max_rows`` rows and a header.
    """
    end = b"\n" if b"\n" in text else b"\r"
    codes = np.frombuffer(text, np.uint8)
    blocks = codes[: len(codes) // _BLOCK_BYTES * _BLOCK_BYTES].reshape(-1, _BLOCK_BYTES)
    lines, may_be_long = 0, False
    for at in range(0, len(blocks), _BLOCKS_AT_ONCE):
        is_end = blocks[at : at + _BLOCKS_AT_ONCE] == end[0]
        lines += int(np.count_nonzero(is_end))
        may_be_long = may_be_long or not is_end.any(axis=1).all()
    check_row_count(lines + text.count(end, blocks.size), max_rows)
    if may_be_long or len(text) - blocks.size > MAX_LINE_BYTES:
        _check_line_lengths(text, end)


def _check_line_lengths(text: bytes, end: bytes) -> None:
    at = 0
    # Hop to the last line end within reach; a window without one is a line that is too long.
    while len(text) - at > MAX_LINE_BYTES:
        last = text.rfind(end, at, at + MAX_LINE_BYTES + 1)
        most = MAX_LINE_BYTES
        if last < 0 and text.startswith(b"#", at):
            most = MAX_COMMENT_BYTES
            last = text.find(end, at, at + most + 1)
        if last < 0:
            line = text.count(end, 0, at) + 1
            raise TelemetryFormatError(f"line {line} is longer than {most} bytes")
        at = last + 1


def check_row_count(rows: int, max_rows: int) -> None:
    """Refuse a table with more than ``max_rows`` rows.

    Raises
    ------
    TooManyRowsError
        There are more.
    """
    if rows > max_rows + 1:
        raise TooManyRowsError(f"the table has more than {max_rows} rows")
