"""Files of Gauss coefficients: the content tells the format, one module each."""

from magcal_core.field.coefficient_files.read import READERS, read_field_file

__all__ = ["READERS", "read_field_file"]
