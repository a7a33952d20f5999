"""A folder that somebody else fills with orbit messages, whatever they are called."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from app.connectors.errors import SourceContentError
from app.connectors.orbits.contract import Limit, Reply, Watched

if TYPE_CHECKING:
    from app.settings import Settings

ENDINGS: Final = {".json": "application/json", ".xml": "application/xml"}
MOST_BYTES: Final = 16 << 20


class Folder:
    """The newest file of ``MAGCAL_ORBIT_FOLDER`` whose name, up to its ending, is the satellite's id or number."""

    limits: tuple[Limit, ...] = ()
    package: str | None = None

    def ask(self, settings: Settings, watched: Watched) -> Reply:
        """Return the newest file of a satellite."""
        if settings.orbit_folder is None or not settings.orbit_folder.is_dir():
            raise SourceContentError("MAGCAL_ORBIT_FOLDER is not a folder")
        names = {*watched.satellite_ids, watched.catalogue_number}
        own = [one for one in settings.orbit_folder.iterdir() if one.is_file() and one.name.partition(".")[0] in names]
        if not own:
            raise SourceContentError("there is no file of this satellite in the folder")
        newest = max(own, key=lambda one: one.stat().st_mtime_ns)
        if newest.stat().st_size > MOST_BYTES:
            raise SourceContentError(f"the file is larger than {MOST_BYTES >> 20} MiB, which is the limit")
        return Reply(newest.read_bytes(), ENDINGS.get(newest.suffix.lower(), "text/plain"))
