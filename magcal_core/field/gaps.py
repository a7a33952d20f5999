"""What may be done with a sample for which the index of the external field has no value."""

from typing import Final

INDEX_GAPS: Final = ("refuse", "mean")
