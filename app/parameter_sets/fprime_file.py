"""The parameter file of F Prime's ``Svc::PrmDb``: a record a parameter, big-endian.

A record is 0xA5, the size of what follows (4 bytes), the parameter's id (4 bytes) and its serialized value, here an
array of F32. Newer releases have the CRC-32 of all records, 4 bytes, before the first (F Prime, Svc/PrmDb, 3.2; the
CRC as `fprime-prm-write` computes it: the start value is 0).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

FPRIME_FILE: Final = "fprime-dat"
"""The format's name."""
DELIMITER: Final = 0xA5
HEAD: Final = struct.Struct(">BII")
ID_BYTES: Final = 4


def parameter_file(numbers: Mapping[str, Sequence[float]], first_id: int, *, has_crc: bool) -> bytes:
    """Return the file of lists of numbers, whose ids follow one another from ``first_id`` on."""
    records = b"".join(
        HEAD.pack(DELIMITER, ID_BYTES + 4 * len(values), first_id + n) + struct.pack(f">{len(values)}f", *values)
        for n, values in enumerate(numbers.values())
    )
    return (_crc(records).to_bytes(4, "big") if has_crc else b"") + records


def records_of(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield id and serialized value of each parameter of a file, with or without a CRC.

    Raises
    ------
    ValueError
        It is no such file, is cut, or its CRC is another one.
    """
    has_crc = len(content) >= ID_BYTES and content[:4] == _crc(content[4:]).to_bytes(4, "big")
    at = 4 if has_crc else 0
    while at < len(content):
        if at + HEAD.size > len(content):
            raise ValueError(f"it is cut at byte {at}")
        delimiter, size, number = HEAD.unpack_from(content, at)
        if delimiter != DELIMITER:
            raise ValueError(f"byte {at} is not 0xA5, and the first four are no CRC of the others")
        end = at + HEAD.size + size - ID_BYTES
        if size < ID_BYTES or end > len(content):
            raise ValueError(f"it is cut in the record at byte {at}")
        yield number, content[at + HEAD.size : end]
        at = end


def _crc(records: bytes) -> int:
    return zlib.crc32(records) ^ 0xFFFF_FFFF
