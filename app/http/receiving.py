"""A body on its way in: streamed, bounded, hashed while it arrives, checked against what its headers say."""

from __future__ import annotations

import asyncio
import base64
import binascii
import hashlib
import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fastapi import Request
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from app.access.authentication import authenticate
from app.access.caller import Caller
from app.errors import (
    BusyError,
    DigestMismatchError,
    QuotaError,
    StorageFullError,
    UnsupportedMediaError,
    UploadStalledError,
    UploadTooLargeError,
    UploadTruncatedError,
)
from app.settings import Settings
from magcal_core.errors import InputError
from magcal_core.telemetry.compression import decompress, is_compressed

IN_MEMORY_BYTES: Final = 1 << 20
CODINGS: Final = frozenset({"gzip", "x-gzip", "zstd"})
DIGEST: Final = re.compile(r"([a-z0-9-]+)=:([A-Za-z0-9+/=]+):")
SLOWEST_BYTES_S: Final = 1000
SLOW_AFTER_S: Final = 60.0
LEFT_AFTER_S: Final = 3600.0
TRUSTED_S: Final = 0.5
"""A key that was right when the body began is asked for again where the body took longer."""


class DigestFormError(InputError):
    """A Content-Digest that cannot be read."""

    code = "digest_form"


@dataclass(frozen=True, slots=True)
class Upload:
    """A body that has arrived whole: its content without content coding, and what it was sent as."""

    content: bytes
    sha256: str
    media_type: str


class Admission:
    """How many uploads may be in flight at once in this process, of all keys and of one."""

    def __init__(self, most: int, most_per_key: int) -> None:
        self._most = most
        self._most_per_key = most_per_key
        self._per_key: Counter[str] = Counter()

    @property
    def in_flight(self) -> int:
        """How many uploads there are at the moment."""
        return self._per_key.total()

    def check(self, caller: Caller) -> None:
        """Raise `QuotaError` or `BusyError` where there is no place: asked first, it refuses a crowd cheaply."""
        used = self._per_key[caller.key_id]
        if used >= self._most_per_key:
            raise QuotaError("uploads in flight of this key", self._most_per_key, used, reset_s=1)
        if self.in_flight >= self._most:
            raise BusyError(f"{self._most} uploads are in flight, which is the limit; try again")

    @asynccontextmanager
    async def place(self, caller: Caller) -> AsyncIterator[None]:
        """Hold a place while an upload is received and kept.

        Raises
        ------
        QuotaError, BusyError
            The key, or all keys together, have as many uploads in flight as they may.
        """
        self.check(caller)
        self._per_key[caller.key_id] += 1
        try:
            yield
        finally:
            self._per_key[caller.key_id] -= 1
            if not self._per_key[caller.key_id]:
                del self._per_key[caller.key_id]


def incoming_dir(settings: Settings) -> Path:
    """Return the folder of bodies on their way in."""
    return settings.data_dir / "incoming"


def sweep_incoming(settings: Settings) -> int:
    """Make the folder of bodies on their way in, and return how many an earlier process left there, now removed."""
    folder = incoming_dir(settings)
    folder.mkdir(parents=True, exist_ok=True)
    left = [path for path in folder.glob("*.part") if time.time() - path.stat().st_mtime > LEFT_AFTER_S]
    for path in left:
        path.unlink(missing_ok=True)
    return len(left)


def is_short(request: Request) -> bool:
    """Return whether the request declares a body that is as soon read as refused."""
    text = request.headers.get("content-length", "")
    return text.isascii() and text.isdigit() and int(text) <= IN_MEMORY_BYTES


def check_declared(request: Request, settings: Settings) -> int:
    """Return the declared size of the body, bytes, 0 where there is none; refuse it before any of it is read.

    Raises
    ------
    UploadTooLargeError, StorageFullError, UnsupportedMediaError
        The body is larger than may be, there is no room for it, or its content coding is unknown.
    """
    text = request.headers.get("content-length", "0")
    declared = int(text) if text.isascii() and text.isdigit() else 0
    if declared > settings.max_upload_mb * 1_000_000:
        raise UploadTooLargeError(f"the body is larger than {settings.max_upload_mb} MB, which is the limit")
    coding = _coding(request)
    if coding != "identity" and coding not in CODINGS:
        raise UnsupportedMediaError("this content coding is not read; known are gzip and zstd")
    free = shutil.disk_usage(settings.data_dir).free
    if free < max(settings.min_free_mb << 20, 2 * declared):
        raise StorageFullError("there is not enough free disk space for the upload")
    return declared


async def receive(request: Request, settings: Settings) -> Upload:
    """Return the whole body of ``request``.

    Raises
    ------
    UploadTooLargeError, UploadTruncatedError, UploadStalledError
        The body outgrew the limit, ended early, or made no progress.
    DigestMismatchError
        It is not what its Content-Digest says.
    InputError
        Its content coding is corrupt, or a bomb.
    UnauthorizedError
        The key was revoked while the body arrived.
    """
    begun = time.monotonic()
    declared = check_declared(request, settings)
    wanted = _wanted_digests(request.headers.get("content-digest", ""))
    hashes = {name: hashlib.new(name) for name in {"sha256", *wanted}}
    folder = str(incoming_dir(settings))
    with tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES, dir=folder, suffix=".part") as spool:
        size, held = 0, list[bytes]()
        async for piece in _pieces(request, settings):
            size += len(piece)
            if size > settings.max_upload_mb * 1_000_000:
                raise UploadTooLargeError(f"the body is larger than {settings.max_upload_mb} MB, which is the limit")
            held.append(piece)
            if sum(map(len, held)) > IN_MEMORY_BYTES:
                await asyncio.to_thread(_take, held, spool, hashes)
                held.clear()
        if size < declared:
            raise UploadTruncatedError(f"the body has {size} of the {declared} bytes that its Content-Length says")
        is_long = size > IN_MEMORY_BYTES
        body = await asyncio.to_thread(_unspooled, held, spool, hashes) if is_long else _joined(held, hashes)
    for name, digest in wanted.items():
        if hashes[name].digest() != digest:
            raise DigestMismatchError("the body does not have the digest that Content-Digest says")
    if time.monotonic() - begun > TRUSTED_S:
        await run_in_threadpool(authenticate, request)
    sha256, media_type = hashes["sha256"].hexdigest(), request.headers.get("content-type", "")
    if not body or _coding(request) == "identity":
        return Upload(body, sha256, media_type)
    return await asyncio.to_thread(_decoded, body, media_type, settings)


Hashes = Mapping[str, "hashlib._Hash"]


def _take(held: list[bytes], spool: tempfile.SpooledTemporaryFile[bytes], hashes: Hashes) -> None:
    """Hash and spool what has arrived, many pieces at once: each change of thread costs as much as hashing one."""
    for piece in held:
        for one in hashes.values():
            one.update(piece)
    spool.writelines(held)


def _unspooled(held: list[bytes], spool: tempfile.SpooledTemporaryFile[bytes], hashes: Hashes) -> bytes:
    _take(held, spool, hashes)
    spool.seek(0)
    return spool.read()


def _joined(held: list[bytes], hashes: Hashes) -> bytes:
    body = b"".join(held)
    for one in hashes.values():
        one.update(body)
    return body


def _coding(request: Request) -> str:
    return request.headers.get("content-encoding", "identity").strip().lower()


async def _pieces(request: Request, settings: Settings) -> AsyncIterator[bytes]:
    clock = asyncio.get_running_loop().time
    begun, received = clock(), 0
    stream = request.stream()
    while True:
        try:
            async with asyncio.timeout(settings.upload_stall_s):
                piece = await anext(stream)
        except StopAsyncIteration:
            return
        except TimeoutError:
            raise UploadStalledError(f"no progress for {settings.upload_stall_s:g} s") from None
        except ClientDisconnect:
            raise UploadTruncatedError("the connection was closed before the body was whole") from None
        received += len(piece)
        elapsed = clock() - begun
        if elapsed > SLOW_AFTER_S and received < SLOWEST_BYTES_S * elapsed:
            raise UploadStalledError(f"slower than {SLOWEST_BYTES_S} bytes/s")
        yield piece


def _wanted_digests(header: str) -> dict[str, bytes]:
    """Return hash name -> digest of a Content-Digest field (RFC 9530); algorithms that are not known are left aside."""
    known = {"sha-256": "sha256", "sha-512": "sha512"}
    found = {}
    for member in filter(None, (part.strip() for part in header.split(","))):
        form = DIGEST.fullmatch(member)
        try:
            digest = base64.b64decode(form[2], validate=True) if form else b""
        except binascii.Error:
            form = None
        if form is None:
            raise DigestFormError("Content-Digest is not of the form sha-256=:BASE64:")
        if form[1] in known:
            found[known[form[1]]] = digest
    return found


def _decoded(body: bytes, media_type: str, settings: Settings) -> Upload:
    if not is_compressed(body):
        raise UnsupportedMediaError("the body is not in the content coding that it declares")
    content = decompress(body, max_bytes=settings.max_decompressed_mb << 20)
    return Upload(content, hashlib.sha256(content).hexdigest(), media_type)
