"""Files of the indices that tell of the external field: the content tells the format, one module each."""

from magcal_core.field.index_files.read import READERS, read_index

__all__ = ["READERS", "read_index"]
