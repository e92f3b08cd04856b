"""Named arrays in one `.npz` file, read from a file that nobody vouches for.

An `.npz` file is a zip archive of arrays, each with a header that states its type and shape. Reading goes in two
passes: first every header is read and compared with what is expected, and the sizes, as the headers and as the archive
state them, with each other and with a limit; only then is memory taken and filled. So a small file cannot demand much
memory, nothing is unpickled, and a truncated or altered archive is told by its check sums.
"""

import os
import sys
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vcjax.storage import replacing

MAX_BYTES = 2**31
"""Most memory that the arrays of a file may take together unless told otherwise: far above recordings of an hour."""


_BLOCK_BYTES = 2**20


class Header(NamedTuple):
    """What an array's header states."""

    dtype: np.dtype
    shape: tuple[int, ...]
    is_fortran: bool
    num_bytes: int


def write_arrays(path: str | os.PathLike, arrays: Mapping[str, np.ndarray]) -> Path:
    """Write named arrays, complete or not at all; equal arrays make equal files, byte for byte.

    Raises:
        ValueError: for an array of Python objects, which could be read by unpickling only.
        OSError: if the place cannot be written; what was there before stays.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise ValueError(f"write_arrays({name}) is {array.dtype}; give numbers, booleans or text.")
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return Path(path)


def read_arrays(path: str | os.PathLike, kinds: Mapping[str, str], max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """Read named arrays back.

    Args:
        path: the file.
        kinds: names that may be in it, each with the kinds of numbers it may hold, as in `numpy.dtype.kind`: "f"
            floating-point, "iu" integers, "b" booleans, "U" text.
        max_bytes: most memory that they may take together.

    Returns:
        The arrays that are there, of those named in `kinds`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming file, array and what is wrong: no archive, truncated or altered, an array that is not known,
            of another kind, of another size than stated, or more memory than `max_bytes`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    try:
        with zipfile.ZipFile(path) as archive:
            headers = _headers(path, archive, kinds)
            needed = sum(header.num_bytes for header in headers.values())
            if needed > max_bytes:
                raise ValueError(
                    f"{path}: its arrays need {needed / 2**20:.0f} MiB of memory, more than the "
                    f"{max_bytes / 2**20:.0f} MiB allowed; keep less in a file, or read it in Python with a "
                    "larger max_bytes."
                )
            return {name: _read(archive, name, header) for name, header in headers.items()}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"{path}: not a sound .npz file ({error}); write it again.") from error


def _headers(path: Path, archive: zipfile.ZipFile, kinds: Mapping[str, str]) -> dict[str, Header]:
    """Headers of all arrays, each of a known name and kind, and as large as the archive says."""
    headers = {}
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if name not in kinds or name in headers or member.filename != f"{name}.npy":
            raise ValueError(f"{path}: {_shown(member.filename)} is no array of this kind of file, or is there twice.")
        if member.flag_bits & 1 or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{path}: {name} is encrypted or compressed in an unknown way; write the file again.")
        with archive.open(member) as file:
            try:
                header = _header(file)
            except Exception as error:  # NumPy reads a header as Python's literals, which fail in many ways
                reason = _shown(str(error) or type(error).__name__)
                raise ValueError(f"{path}: {name} has no readable header ({reason}).") from error
            stated = member.file_size - file.tell()
        if header.dtype.kind not in kinds[name]:
            raise ValueError(f"{path}: {name} is {header.dtype}; {_NEEDED[kinds[name]]} are needed.")
        if header.dtype.kind == "f" and header.dtype.itemsize > 8:
            raise ValueError(f"{path}: {name} is {header.dtype}; numbers of at most 64 bits are needed.")
        if stated != header.num_bytes:
            raise ValueError(
                f"{path}: {name} has {stated} bytes, but shape {header.shape} of {header.dtype} has {header.num_bytes}."
            )
        headers[name] = header
    return headers


_NEEDED = {"f": "floating-point numbers", "iu": "integers", "b": "booleans", "U": "texts"}


def _header(file: Any) -> Header:
    """The header of an array, of which NumPy reads no more than 10 000 bytes."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"version {version} of the .npy format")
    shape, is_fortran, dtype = read(file)
    if dtype.hasobject or dtype.shape or dtype.names or not dtype.itemsize:
        raise ValueError(f"type {dtype}")
    if not all(0 <= length < 2**40 for length in shape):
        raise ValueError(f"shape {shape}")
    num_bytes = dtype.itemsize
    for length in shape:  # Python's integers do not overflow
        num_bytes *= length
    return Header(dtype, shape, is_fortran, num_bytes)


def _read(archive: zipfile.ZipFile, name: str, header: Header) -> np.ndarray:
    """An array whose header has been accepted."""
    content = bytearray(header.num_bytes)
    with archive.open(f"{name}.npy") as file:
        _header(file)
        filled = 0
        while block := file.read(_BLOCK_BYTES):  # to the end, where the archive compares the check sum
            content[filled : filled + len(block)] = block
            filled += len(block)
    if filled != header.num_bytes:
        raise zipfile.BadZipFile(f"{name} ends early")
    array = np.frombuffer(content, header.dtype).reshape(header.shape, order="F" if header.is_fortran else "C")
    array = array.astype(header.dtype.newbyteorder("="), copy=False)
    if array.dtype.kind == "U" and np.any(np.frombuffer(array.tobytes(), np.uint32) > sys.maxunicode):
        raise zipfile.BadZipFile(f"{name} is no text")
    return array


def _shown(text: str) -> str:
    """A text from the file in a message: quoted and short."""
    return repr(text if len(text) <= 60 else f"{text[:57]}…")
