"""Read the arrays of an .npz file without trusting the sizes that it declares.

Declared sizes are compared with the size of the file before an array is allocated.
Stored members cannot be larger than the file. Compressed members are inflated to their
declared size and no further; deflate must be able to reach that size, and all of them
together may have at most MAX_INFLATED bytes. Headers are matched against a regular
expression and not evaluated. Objects, which would be unpickled, are refused.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from sfkd_jax.store._files import ArtefactError, failure, open_regular

PORTABLE = "biufcSUmM"
"""Kinds of dtype that an .npz file preserves."""
MAX_INFLATED = 1 << 29
"""Total size of the compressed members of one file after inflation [bytes]."""
DEFLATE_RATIO = 1032
"""Largest ratio by which deflate can inflate."""
MAX_HEADER = 2048
"""Size of a header [bytes]; numpy writes 118 for most arrays."""
CHUNK = 1 << 20
MAX_DIRECTORY = 1 << 22
"""Size of a zip directory [bytes], enough for about 40000 arrays; the zip library
allocates twenty times as much.
"""
_DATE = (1980, 1, 1, 0, 0, 0)
_ENTRY = (
    r"'descr':\s*'(?P<order>[<>|=]?)(?P<kind>[A-Za-z?])(?P<size>\d*(?:\[\w+\])?)'",
    r"'fortran_order':\s*(?P<fortran>True|False)",
    r"'shape':\s*\((?P<shape>[\d\s,L]*)\)",
)
_HEADER = re.compile(rf"\{{\s*(?:(?:{'|'.join(_ENTRY)})\s*(?:,\s*)?){{3}}\}}\s*")


class _Reader(io.BufferedReader):
    """A file whose reads are limited to MAX_DIRECTORY bytes each."""

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(
            MAX_DIRECTORY if size is None or size < 0 else min(size, MAX_DIRECTORY)
        )


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a file without a manifest; pickles are never loaded.

    Raises:
        ArtefactError: missing, no regular file, truncated, damaged or foreign; objects;
            or more than MAX_INFLATED bytes of compressed arrays.
    """
    with open_regular(path) as file:
        check_zip(path, file)
        return members(path, file)


def check_zip(path: Path, file: BinaryIO) -> None:
    """Refuse an incomplete zip file after reading only its start and its end."""
    if not b"PK".startswith(file.read(2)):
        raise failure(path, "foreign, not a zip file of arrays")
    if not zipfile.is_zipfile(file):
        raise failure(path, "truncated, the end of the zip file is missing")


def members(path: Path, file: io.FileIO) -> dict[str, np.ndarray]:
    """Return the arrays of an open zip file and close it; see `read_npz`."""
    size = file.seek(0, io.SEEK_END)
    try:
        with _Reader(file) as bounded, zipfile.ZipFile(bounded) as zip_file:
            listed = zip_file.infolist()
            _check_directory(path, listed, size)
            return {
                info.filename.removesuffix(".npy"): _array(path, zip_file, info)
                for info in listed
            }
    except ArtefactError:
        raise
    except Exception as error:  # a damaged file raises nearly anything
        raise failure(path, f"damaged ({error or type(error).__name__})") from error


def write_npz(
    file: BinaryIO, arrays: Mapping[str, np.ndarray], *, compressed: bool
) -> None:
    """Write as np.savez does, for any names, without pickles, byte-reproducible."""
    with zipfile.ZipFile(file, "w") as zip_file:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy", _DATE)
            info.compress_type = (
                zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
            )
            with zip_file.open(info, "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def _check_directory(path: Path, listed: list[zipfile.ZipInfo], size: int) -> None:
    """Refuse members that the directory declares and the file cannot hold."""
    names = [info.filename for info in listed]
    if odd := [name for name in names if not name.endswith(".npy")]:
        raise failure(path, f"holds {odd[0][:60]!r}, which is no array")
    if len(set(names)) < len(names):
        raise failure(path, "holds two arrays of one name")
    packed = [info for info in listed if info.compress_type == zipfile.ZIP_DEFLATED]
    stored = [info for info in listed if info.compress_type == zipfile.ZIP_STORED]
    if len(packed) + len(stored) < len(listed):
        raise failure(path, "is compressed by another method than deflate")
    if (
        sum(info.file_size for info in stored) > size
        or sum(info.compress_size for info in packed) > size
    ):
        raise failure(
            path, f"damaged (its arrays are declared larger than its {size} bytes)"
        )
    if any(info.file_size > DEFLATE_RATIO * info.compress_size for info in packed):
        raise failure(
            path, "damaged (a member is declared larger than it can inflate to)"
        )
    if (inflated := sum(info.file_size for info in packed)) > MAX_INFLATED:
        raise failure(
            path,
            f"inflates to {inflated >> 20} MiB, more than {MAX_INFLATED >> 20}; "
            "store it uncompressed",
        )


def _array(path: Path, zip_file: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Read one member; the zip library compares its checksum at the last byte."""
    with zip_file.open(info) as entry:
        kind, shape, order, begins = _header(path, entry)
        size = math.prod(shape) * kind.itemsize
        if begins + size != info.file_size:
            raise ValueError(
                f"{info.filename} declares {size} bytes "
                f"and holds {info.file_size - begins}"
            )
        content = np.empty(size, np.uint8)
        for start in range(0, size, CHUNK):
            part = content[start : start + CHUNK]
            part[:] = np.frombuffer(_exactly(entry, len(part)), np.uint8)
    array = content.view(kind).reshape(shape, order=order)
    if kind.kind == "U" and not _is_text(content.view(f"{kind.byteorder}u4")):
        raise ValueError(f"{info.filename} holds text that is not Unicode")
    return array


def _header(
    path: Path, entry: Any
) -> tuple[np.dtype, tuple[int, ...], Literal["C", "F"], int]:
    """Return dtype, shape, order and length of the header of a .npy file."""
    magic = _exactly(entry, 8)
    if magic[:6] != b"\x93NUMPY" or magic[6] not in (1, 2, 3) or magic[7]:
        raise ValueError(f"{entry.name} is no array of numpy")
    width = 2 if magic[6] == 1 else 4
    length = int.from_bytes(_exactly(entry, width), "little")
    if length > MAX_HEADER:
        raise ValueError(f"{entry.name} has a header of {length} bytes")
    header = _HEADER.fullmatch(_exactly(entry, length).decode("latin1"))
    if not header or None in header.group("kind", "fortran", "shape"):
        raise ValueError(f"{entry.name} has no header of plain numbers")
    if header["kind"] == "O":
        raise failure(path, "holds pickled objects, refused")
    if header["kind"] not in PORTABLE:
        raise ValueError(f"{entry.name} is of a dtype that is not portable")
    kind, listed = (
        np.dtype("".join(header.group("order", "kind", "size"))),
        header["shape"].strip(),
    )
    if not kind.itemsize or (listed and "," not in listed):
        raise ValueError(f"{entry.name} has no shape or no size")
    shape = tuple(
        int(length.strip().removesuffix("L"))
        for length in listed.rstrip(",").split(",")
        if listed
    )
    return kind, shape, "F" if header["fortran"] == "True" else "C", 8 + width + length


def _exactly(entry: Any, count: int) -> bytes:
    content = entry.read(count)
    if len(content) < count:
        raise ValueError(f"{entry.name} ends too early")
    return content


def _is_text(letters: np.ndarray) -> bool:
    """Whether all are code points and none is half of a surrogate pair."""
    return not np.any(
        (letters > 0x10FFFF) | ((letters >= 0xD800) & (letters <= 0xDFFF))
    )
