"""Take gzip and zstd off a body without letting it grow past a limit."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Final

import zstandard

from magcal_core.errors import DecompressionLimitError, TelemetryFormatError
from magcal_core.foreign_files import binary_file

MAX_DECOMPRESSED_BYTES: Final = 512 << 20
"""Bytes that a compressed body may grow to."""
MAX_RATIO: Final = 20
"""Growth allowed once a body has passed `RATIO_COUNTS_FROM_BYTES`; telemetry compresses by 2 to 10."""
RATIO_COUNTS_FROM_BYTES: Final = 8 << 20
"""Decompressed bytes below which no ratio is suspicious."""

_GZIP: Final = b"\x1f\x8b"
_ZSTD: Final = b"\x28\xb5\x2f\xfd"
_ARCHIVES: Final = ("archive", "a bzip2 file", "an xz file")
"""What is refused as it is, whatever it may hold."""
_CHUNK: Final = 1 << 20
_ZSTD_STEP: Final = 1024
"""Compressed bytes given to zstd at once: it bounds no output, and one block of 4 bytes may grow to 128 KiB."""
_ZSTD_WINDOW_BYTES: Final = 128 << 20


def is_compressed(data: bytes) -> bool:
    """Return whether ``data`` begins like gzip or zstd."""
    return data.startswith((_GZIP, _ZSTD))


def decompress(data: bytes, *, max_bytes: int = MAX_DECOMPRESSED_BYTES) -> bytes:
    """Return the body inside ``data``, which may be plain, gzip or zstd.

    Raises
    ------
    DecompressionLimitError
        The body grows past ``max_bytes``, or more than twentyfold.
    TelemetryFormatError
        The compressed stream is cut short or corrupt, or holds or is an archive.
    """
    if not is_compressed(data):
        _refuse_archive(data)
        return data
    kind, pieces = ("gzip", _gunzip(data)) if data.startswith(_GZIP) else ("zstd", _unzstd(data))
    body = bytearray()
    try:
        for consumed, piece in pieces:
            body += piece
            _check_growth(len(body), consumed, max_bytes)
    except (zlib.error, zstandard.ZstdError) as error:
        raise TelemetryFormatError(f"the {kind} stream is corrupt after {len(body)} bytes") from error
    inside = bytes(body)
    if is_compressed(inside):
        raise TelemetryFormatError(f"the {kind} stream holds another compressed stream; send it compressed once")
    _refuse_archive(inside)
    return inside


def _refuse_archive(data: bytes) -> None:
    found = binary_file(data)
    if found is not None and found.endswith(_ARCHIVES):
        raise TelemetryFormatError(f"the body is {found}; accepted are plain, gzip and zstd")


def _check_growth(grown: int, consumed: int, max_bytes: int) -> None:
    if grown > max_bytes:
        raise DecompressionLimitError(f"the body grows past {max_bytes >> 20} MiB")
    if grown > RATIO_COUNTS_FROM_BYTES and grown > MAX_RATIO * consumed:
        ratio = grown / consumed
        raise DecompressionLimitError(f"the body grows {ratio:.0f} times; the limit is {MAX_RATIO} times past 8 MiB")


def _gunzip(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (compressed bytes consumed, decompressed piece) over every gzip member."""
    at = 0
    while at < len(data):
        if not data.startswith(_GZIP, at):
            raise TelemetryFormatError(f"the gzip stream is followed by {len(data) - at} bytes that are not gzip")
        member = zlib.decompressobj(wbits=31)
        pending = b""
        while not member.eof:
            if not pending:
                pending = data[at : at + _CHUNK]
                at += len(pending)
                if not pending:
                    raise TelemetryFormatError("the gzip stream is cut short")
            piece = member.decompress(pending, _CHUNK)
            pending = member.unconsumed_tail
            yield at - len(pending), piece
        at -= len(member.unused_data)


def _unzstd(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (compressed bytes consumed, decompressed piece) over every zstd frame."""
    at = 0
    while at < len(data):
        if not data.startswith(_ZSTD, at):
            raise TelemetryFormatError(f"the zstd stream is followed by {len(data) - at} bytes that are not zstd")
        frame = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW_BYTES).decompressobj()
        while not frame.eof:
            pending = data[at : at + _ZSTD_STEP]
            if not pending:
                raise TelemetryFormatError("the zstd stream is cut short")
            at += len(pending)
            yield at, frame.decompress(pending)
        at -= len(frame.unused_data)
