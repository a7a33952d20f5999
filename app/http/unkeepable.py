"""Text that a database cannot keep, refused at the door on each of them.

PostgreSQL has no NUL in its text, and neither database has halves of a surrogate pair. SQLite would take some of it,
and the same request would have two answers.
"""

from __future__ import annotations

import re
from typing import Final

UNKEEPABLE: Final = re.compile("[\\x00\\ud800-\\udfff]")


def has_unkeepable(text: str) -> bool:
    """Return whether ``text`` has a NUL or half of a surrogate pair."""
    return UNKEEPABLE.search(text) is not None
