"""The files of a station's folder, which are `magcal_client`'s."""

from magcal_client.errors import FolderTakenError
from magcal_client.folder import Look, aside, is_being_written, is_too_long, put_aside, read_file, taken

__all__ = ["FolderTakenError", "Look", "aside", "is_being_written", "is_too_long", "put_aside", "read_file", "taken"]
