"""What may be chosen of a field beside its main model, known without loading any model."""

from typing import Final

INDEX_GAPS: Final = ("refuse", "mean")
"""What may be done with a sample for which the index of the external field has no value."""
EXTERNAL_KINDS: Final = {"rc": "RC", "dst": "Dst", "mean": None}
"""Suffix of a model's name -> the index that it needs."""
