"""What a field model is made from beside its name: indices and a file of coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from magcal_core.errors import IndexMissingError, OptionError
from magcal_core.field.coefficients import CoefficientFile
from magcal_core.field.hourly import HourlyIndex, hourly
from magcal_core.field.index import Index

OneIndex = Index | str | Path | bytes | BinaryIO
GivenIndices = OneIndex | Sequence[OneIndex] | None
FieldFile = CoefficientFile | str | Path | bytes | BinaryIO | None


@dataclass(frozen=True, slots=True)
class FieldSources:
    """Indices, of which the later holds, and a file of coefficients.

    Attributes
    ----------
    indices : tuple of Index
    file : CoefficientFile, optional
    """

    indices: tuple[Index, ...] = ()
    file: CoefficientFile | None = None

    @classmethod
    def of(cls, index: GivenIndices = None, field_file: FieldFile = None) -> FieldSources:
        """Return the sources that are given as values, as paths, as bytes or as open files.

        Raises
        ------
        IndexFormatError, FieldFileError
            A file is none that magcal reads.
        """
        if index is None:
            given: list[OneIndex] = []
        elif isinstance(index, (list, tuple)):
            given = list(index)
        else:
            given = [cast("OneIndex", index)]
        indices = tuple(item if isinstance(item, Index) else _index_of(item) for item in given)
        if field_file is None or isinstance(field_file, CoefficientFile):
            return cls(indices, field_file)
        from magcal_core.field.coefficient_files.read import read_field_file

        return cls(indices, read_field_file(field_file))

    def hourly(self, name: str) -> HourlyIndex | None:
        """Return the hourly index ``name`` of all files together; None where there is none."""
        return _hourly(self.indices, name)

    def require_hourly(self, name: str, what: str) -> HourlyIndex:
        """Return the same for ``what`` needs it.

        Raises
        ------
        IndexMissingError
            There is none.
        """
        found = self.hourly(name)
        if found is None:
            raise IndexMissingError(f"{what} needs the index {name}, which is not there")
        return found

    def require_file(self, what: str) -> CoefficientFile:
        """Return the file of coefficients for ``what`` needs it.

        Raises
        ------
        OptionError
            There is none.
        """
        if self.file is None:
            raise OptionError(f"field: {what} needs a file of coefficients (field_file)")
        return self.file

    def require_kp(self, what: str) -> None:
        """Raise `IndexMissingError` where there is no Kp, which ``what`` needs."""
        if not self.kp():
            raise IndexMissingError(f"{what} needs the index Kp, which is not there")

    def kp(self) -> tuple[Index, ...]:
        """Return the files of Kp, the last first: the first one with a value holds."""
        return tuple(index for index in reversed(self.indices) if index.name == "Kp")

    def kp_at(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Kp at ``stamps_ns``, shape (n,), NaN where there is none, and which of `kp` gave it, -1 none."""
        value = np.full(len(stamps_ns), np.nan)
        source = np.full(len(stamps_ns), -1, np.int64)
        for number, index in enumerate(self.kp()):
            row = np.searchsorted(index.start_ns, stamps_ns, side="right") - 1
            inside = (row >= 0) & (stamps_ns < index.start_ns[np.maximum(row, 0)] + index.step_ns)
            found = np.where(inside, index.value[np.maximum(row, 0)], np.nan)
            is_new = np.isnan(value) & ~np.isnan(found)
            value[is_new], source[is_new] = found[is_new], number
        return value, source


def _index_of(source: str | Path | bytes | BinaryIO) -> Index:
    from magcal_core.field.index_files.read import read_index

    return read_index(source)


@lru_cache(maxsize=8)
def _hourly(indices: tuple[Index, ...], name: str) -> HourlyIndex | None:
    """Return what `hourly` does: several models of one session ask for it."""
    return hourly(indices, name)
