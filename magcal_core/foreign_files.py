"""What a file is that is neither telemetry nor an orbit: spreadsheets, documents, other binary files, web pages."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

_SPREADSHEET: Final = "save the sheet as CSV and send that"
_SIGNATURES: Final[Mapping[bytes, str]] = {
    b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1": f"an old Excel or Office file (.xls); {_SPREADSHEET}",
    b"PK\x03\x04": "a zip archive",
    b"PK\x05\x06": "a zip archive",
    b"\xfd7zXZ\x00": "an xz file",
    b"7z\xbc\xaf\x27\x1c": "a 7z archive",
    b"Rar!": "a rar archive",
    b"%PDF": "a PDF document",
    b"\x89PNG": "a PNG picture",
    b"\x89HDF": "an HDF5 file (NetCDF-4 and MATLAB 7.3 files are such)",
    b"CDF\x01": "a NetCDF file",
    b"CDF\x02": "a NetCDF file",
    b"CDF\x05": "a NetCDF file",
    b"\xcd\xf3\x00\x01": "a CDF file",
    b"\xcd\xf2\x60\x02": "a CDF file",
    b"MATLAB 5.0": "a MATLAB file",
    b"SIMPLE  =": "a FITS file",
    b"DAF/": "an SPK kernel",
    b"\x93NUMPY": "a NumPy array file (.npy)",
    b"SQLite format 3\x00": "an SQLite database",
    b"ARROW1\x00\x00": "an Arrow file",
    b"Obj\x01": "an Avro file",
}
_SHEETS: Final = {
    b"xl/": f"an Excel workbook (.xlsx); {_SPREADSHEET}",
    b"mimetypeapplication/vnd.oasis.opendocument.spreadsheet": f"an OpenDocument sheet (.ods); {_SPREADSHEET}",
}
"""What a zip archive is whose first members are these."""
HTML: Final = r"(?:<\?xml[^>]*>\s*|<!--(?:(?!-->)[\s\S])*-->\s*)*(?:<!doctype html|<html|<head|<body)"
"""How a web page begins, as a regular expression that does not tell small letters from capitals."""
_PAGE: Final = re.compile(HTML, re.IGNORECASE)
_TITLE: Final = re.compile(r"<title[^>]*>\s*([^<]{1,200})", re.IGNORECASE)
_HEAD: Final = 1 << 12
_LONGEST_TITLE: Final = 80


def binary_file(content: bytes) -> str | None:
    """Return what a binary file is, in words, by the bytes that it begins with; None where they tell of none."""
    head = content[:_HEAD]
    if head[257:262] == b"ustar":
        return "a tar archive"
    if head.startswith(b"BZh") and head[4:10] == b"1AY&SY":
        return "a bzip2 file"
    for magic, words in _SIGNATURES.items():
        if head.startswith(magic):
            sheets = [sheet for mark, sheet in _SHEETS.items() if mark in head]
            return sheets[0] if sheets and magic == b"PK\x03\x04" else words
    return None


def web_page(content: bytes) -> str | None:
    """Return ``an HTML page`` with its title where ``content`` is one, else None."""
    start = content[:_HEAD].decode("utf-8", "replace").lstrip("\ufeff \t\r\n")
    return page_words(start) if _PAGE.match(start) else None


def page_words(page: str) -> str:
    """Return ``an HTML page`` with its title, quoted and cut, for messages."""
    found = _TITLE.search(page)
    if found is None:
        return "an HTML page"
    title = " ".join(found[1].split())
    return f"an HTML page, {(title if len(title) <= _LONGEST_TITLE else f'{title[:_LONGEST_TITLE]}...')!r}"
