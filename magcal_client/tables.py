"""Tables as data frames, where pandas is installed."""

from __future__ import annotations

import importlib
import io
from typing import TYPE_CHECKING, cast

from magcal_client.errors import PandasMissingError

if TYPE_CHECKING:
    import pandas


def frame_of(content: bytes) -> pandas.DataFrame:
    """Return a CSV table as a data frame, its column ``time`` as times.

    Raises
    ------
    PandasMissingError
        pandas is not installed.
    """
    try:
        library = importlib.import_module("pandas")
    except ImportError as error:
        raise PandasMissingError("a data frame needs pandas: pip install pandas") from error
    frame = library.read_csv(io.BytesIO(content))
    if "time" in frame:
        frame["time"] = library.to_datetime(frame["time"], utc=True)
    return cast("pandas.DataFrame", frame)
