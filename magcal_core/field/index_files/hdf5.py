"""RC as the package chaosmagpy brings it along: ``RC_index.h5`` with ``time``, ``RC``, ``RC_e`` and ``RC_i``."""

from __future__ import annotations

import io
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import IndexFormatError
from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.index_files.dtu_rc import add_hours
from magcal_core.field.index_files.rows import Rows

MAGIC: Final = b"\x89HDF\r\n\x1a\n"
_COLUMNS: Final = ("time", "RC", "RC_e", "RC_i")
_MOST_ROWS: Final = 2_000_000


def read(content: bytes, sha256: str) -> Index:
    """Return the index of an HDF5 file.

    Raises
    ------
    IndexFormatError
        h5py is not installed, the file is corrupt, lacks a column, or has a value that cannot be.
    """
    try:
        import h5py
    except ImportError as error:
        raise IndexFormatError("an HDF5 file needs the extra magcal-service[hdf5] (h5py)") from error
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            missing = [name for name in _COLUMNS if not isinstance(file.get(name), h5py.Dataset)]
            if missing:
                raise IndexFormatError(f"the HDF5 file has no column {missing[0]}; want {', '.join(_COLUMNS)}")
            shapes = {file[name].shape for name in _COLUMNS}
            (count,) = shapes.pop() if len(shapes) == 1 and len(next(iter(shapes))) == 1 else (-1,)
            if not 0 < count <= _MOST_ROWS:
                raise IndexFormatError(f"the columns of the HDF5 file are not of one length from 1 to {_MOST_ROWS}")
            table = np.stack([np.asarray(file[name][:], np.float64) for name in _COLUMNS], axis=1)
    except (OSError, ValueError, TypeError, KeyError, RuntimeError) as error:
        raise IndexFormatError("the HDF5 file is corrupt") from error
    return _index(table, sha256)


def _index(table: Floats, sha256: str) -> Index:
    rows = Rows(HOUR_NS)
    for row in np.flatnonzero(~np.isfinite(table).all(axis=1)):
        rows.refuse(int(row) + 1, "a value is not finite")
    add_hours(rows, range(1, len(table) + 1), table)
    return rows.index("RC", "hdf5", sha256)
