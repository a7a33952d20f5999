"""What is known of a format of tables without loading what reads and writes it, and what that code is."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from magcal_core.errors import OptionError

if TYPE_CHECKING:
    import pyarrow as pa

    from magcal_core.telemetry.columns import ColumnMap, TableForm
    from magcal_core.telemetry.table import RawTable

T = TypeVar("T")


class Reader(Protocol):
    """Reads one format."""

    def __call__(self, data: bytes, columns: ColumnMap | None, *, max_rows: int, form: TableForm) -> RawTable:
        """Return the table in ``data``, its columns named by ``columns`` and written as ``form`` declares.

        Raises
        ------
        InputError
            With every fault of the table.
        """
        ...


@dataclass(frozen=True, slots=True)
class TableCode:
    """What reads and writes one format.

    Attributes
    ----------
    read : reader of telemetry; None where the format is only written.
    write : table -> bytes; None where the format is only read.
    arrow : bytes -> table, as it was written, nothing judged: how residual tables are read back. None where it cannot.
    """

    read: Reader | None = None
    write: Callable[[pa.Table], bytes] | None = None
    arrow: Callable[[bytes], pa.Table] | None = None


def _never(_head: bytes) -> bool:
    return False


@dataclass(frozen=True, slots=True)
class TableFormat:
    """One format of tables.

    Attributes
    ----------
    load : returns the format's code; called when a table is read or written, so that names cost nothing.
    is_read, is_written, is_read_back : whether the code has ``read``, ``write`` and ``arrow``.
    media_types : content types; the first is what magcal answers with. Of none given, ``application/x-NAME``.
    suffixes : endings of files with their dot, in lower case. Of none given, ``.NAME``.
    signature : bytes that every table of the format begins with, and none of another; empty where there are none.
    looks_like : whether a body without a signature, byte order mark and blanks taken off, begins like the format.
    """

    load: Callable[[], TableCode]
    is_read: bool = True
    is_written: bool = True
    is_read_back: bool = True
    media_types: tuple[str, ...] = ()
    suffixes: tuple[str, ...] = ()
    signature: bytes = b""
    looks_like: Callable[[bytes], bool] = _never

    def media_types_of(self, name: str) -> tuple[str, ...]:
        """Return the content types of this format, whose name is ``name``."""
        return self.media_types or (f"application/x-{name}",)

    def suffixes_of(self, name: str) -> tuple[str, ...]:
        """Return the endings of this format, whose name is ``name``."""
        return self.suffixes or (f".{name}",)

    def has_signature(self, data: bytes) -> bool:
        """Return whether ``data`` begin with the signature of this format."""
        return bool(self.signature) and data.startswith(self.signature)

    def read(self, data: bytes, columns: ColumnMap | None, *, max_rows: int, form: TableForm) -> RawTable:
        """Return the table in ``data``, as `Reader` says.

        Raises
        ------
        OptionError
            The format is only written.
        InputError
            With every fault of the table.
        """
        return _there(self.load().read)(data, columns, max_rows=max_rows, form=form)

    def write(self, table: pa.Table) -> bytes:
        """Return ``table`` in this format.

        Raises
        ------
        OptionError
            The format is only read.
        """
        return _there(self.load().write)(table)

    def arrow(self, data: bytes) -> pa.Table:
        """Return the table in ``data`` as it was written, nothing judged.

        Raises
        ------
        OptionError
            The format cannot be read back.
        """
        return _there(self.load().arrow)(data)


def _there(function: T | None) -> T:
    if function is None:
        raise OptionError("this format of tables is not for that")
    return function


_ANSWER: Final = re.compile(
    rb'\{(?:\s*"[^"]*"\s*:\s*(?:"[^"]*"|\{[^{}]*\}|[^\s",{}\[\]]+)\s*,)*+\s*"[^"]*"\s*:\s*\[\s*\{'
)
"""An object that comes to an array of objects by members that are neither arrays nor nested."""


def opens_columns(head: bytes) -> bool:
    """Return whether a JSON object is one table: it begins with an array, or it holds an array of objects."""
    if not head.startswith(b"{"):
        return False
    return head[head.find(b":") + 1 :].lstrip().startswith(b"[") or _ANSWER.match(head) is not None
