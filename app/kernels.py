"""Compiled kernels that came with the installation: put where numba looks for them, which must be writable."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Final

BUILT: Final = Path(sys.prefix) / "kernels"
"""Where an image keeps the kernels that were compiled as it was built."""


def bring_kernels(built: Path = BUILT) -> int:
    """Copy the kernels that came along into ``NUMBA_CACHE_DIR`` and return how many files are new there.

    Numba takes a cache only from a folder that it can write to, and an image is read-only. A file appears whole or not
    at all, so that processes may start at once.
    """
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if not folder or not built.is_dir():
        return 0
    import shutil
    import tempfile

    brought = 0
    for source in sorted(built.rglob("*.nb[ic]")):
        target = Path(folder) / source.relative_to(built)
        if target.exists():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=target.parent, delete=False) as whole:
            whole.write(source.read_bytes())
        shutil.copystat(source, whole.name)
        Path(whole.name).replace(target)
        brought += 1
    return brought
