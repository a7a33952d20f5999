"""A column that says which readings are good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.errors import OptionError

_NOT_GOOD: Final = frozenset(
    {"", "0", "false", "f", "no", "n", "off", "invalid", "bad", "error", "fail", "failed", "nan"}
)
"""What says, where no values are given, that a reading is not good; everything else says that it is."""


@dataclass(frozen=True, slots=True)
class Validity:
    """A column of the table, by its own name, and the values at which a reading is good.

    Attributes
    ----------
    column : the table's own name of the column.
    values : the good ones; empty: all but 0, false, no, invalid, bad and the like.
    """

    column: str
    values: tuple[str, ...] = ()

    @classmethod
    def of(cls, column: str | None, values: Sequence[str | float] | None = None) -> Validity | None:
        """Return the validity column of that name, None where there is none.

        Raises
        ------
        OptionError
            Values are given without a column.
        """
        if column is None or not column.strip():
            if values:
                raise OptionError("values of a validity column are given, and no validity column")
            return None
        return cls(column.strip(), tuple(_plain(value) for value in values or ()))

    def is_good(self, cells: Sequence[object]) -> NDArray[np.bool_]:
        """Return which readings are good by the cells of the column, shape (n,); an empty cell says that one is not."""
        said = {cell: self._says_good(_plain(cell)) for cell in set(map(_hashable, cells))}
        return np.array([said[_hashable(cell)] for cell in cells], bool)

    def _says_good(self, text: str) -> bool:
        return text in self.values if self.values else text not in _NOT_GOOD


def _hashable(cell: object) -> object:
    return cell if isinstance(cell, str | int | float | bool) or cell is None else str(cell)


def _plain(value: object) -> str:
    """Return a cell as it is compared: lower case, numbers without what does not count."""
    text = "" if value is None else str(value).strip().lower()
    try:
        return f"{float(text):.12g}"
    except ValueError:
        return text
