"""Compressed bodies: what is accepted, and bombs."""

import bz2
import gzip
import io
import zipfile

import pytest
import zstandard

from magcal_core.errors import DecompressionLimitError, TelemetryFormatError
from magcal_core.telemetry.compression import decompress

BODY = bytes(range(256)) * 500


@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress, bytes], ids=["gzip", "zstd", "plain"])
def test_a_body_comes_out_as_it_went_in(pack: type[bytes]) -> None:
    assert decompress(pack(BODY)) == BODY


@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress], ids=["gzip", "zstd"])
def test_members_one_after_another_are_one_body(pack: type[bytes]) -> None:
    assert decompress(pack(BODY) + pack(b"tail")) == BODY + b"tail"


@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress], ids=["gzip", "zstd"])
def test_a_stream_cut_short_is_refused_wherever_it_is_cut(pack: type[bytes]) -> None:
    packed = pack(BODY)
    for cut in (5, len(packed) // 2, len(packed) - 1):
        with pytest.raises(TelemetryFormatError, match="cut short"):
            decompress(packed[:cut])


@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress], ids=["gzip", "zstd"])
def test_what_follows_the_stream_is_refused(pack: type[bytes]) -> None:
    with pytest.raises(TelemetryFormatError, match="followed by 4 bytes"):
        decompress(pack(BODY) + b"junk")


def test_a_flipped_byte_is_found() -> None:
    packed = bytearray(gzip.compress(BODY))
    packed[-6] ^= 1
    with pytest.raises(TelemetryFormatError, match="corrupt"):
        decompress(bytes(packed))


@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress], ids=["gzip", "zstd"])
def test_a_bomb_is_refused_by_its_ratio(pack: type[bytes]) -> None:
    with pytest.raises(DecompressionLimitError, match="20 times"):
        decompress(pack(bytes(32 << 20)))


def test_a_body_past_the_limit_is_refused() -> None:
    with pytest.raises(DecompressionLimitError, match="1 MiB"):
        decompress(gzip.compress(bytes(2 << 20)), max_bytes=1 << 20)


def test_small_bodies_may_compress_well() -> None:
    assert len(decompress(gzip.compress(bytes(4 << 20)))) == 4 << 20


@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress], ids=["gzip", "zstd"])
def test_nested_streams_and_archives_are_refused(pack: type[bytes]) -> None:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as zipped:
        zipped.writestr("pass.csv", BODY)
    for inside in (gzip.compress(BODY), zstandard.compress(BODY), archive.getvalue(), bz2.compress(BODY)):
        with pytest.raises(TelemetryFormatError):
            decompress(pack(inside))
    for plain in (archive.getvalue(), bz2.compress(BODY)):
        with pytest.raises(TelemetryFormatError, match="accepted are plain, gzip and zstd"):
            decompress(plain)
