"""Files that are complete or not there: written under a temporary name in the same folder, flushed, then renamed."""

import contextlib
import glob
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

LEFTOVER_AGE_S = 600.0
"""No write is silent for so long."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """A temporary path to write to, which becomes `path` when the block ends; folders are made as needed.

    If the block fails, what was at `path` before stays, and the temporary file goes. Leftovers of a process that was
    killed while writing the same file are removed.

    Raises:
        OSError: if the place cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(f"{path.parent} is a file; give a place in a directory.") from None
    remove_leftovers(path.parent, glob.escape(path.name))
    with _naming(path):
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        with _naming(path, instead_of=temporary):
            yield temporary
            with open(temporary, "rb") as written:
                os.fsync(written.fileno())
            temporary.chmod(0o666 & ~_umask())
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def filling(folder: str | os.PathLike, last: str, stale: Sequence[str]) -> Iterator[Path]:
    """A temporary folder to write files to, which move into `folder` when the block ends; folders are made as needed.

    If the block fails, nothing in `folder` changes. Other files in it stay as they are.

    Args:
        folder: where the files go.
        last: the file that says that the others are complete: an old one goes before the first moves, the new one moves
            last, so that files of two writers are never taken for one's.
        stale: patterns of files of earlier writers that are removed where no new ones replace them.

    Raises:
        OSError: if the place cannot be written.
    """
    folder = Path(folder)
    is_new = not folder.exists()
    check_writable(folder / last)
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(".filling.*.tmp"):
        if time.time() - leftover.stat().st_mtime > LEFTOVER_AGE_S:
            shutil.rmtree(leftover, ignore_errors=True)
    temporary = Path(tempfile.mkdtemp(prefix=".filling.", suffix=".tmp", dir=folder))
    try:
        yield temporary
        files = sorted(path.relative_to(temporary) for path in temporary.rglob("*") if path.is_file())
        (folder / last).unlink(missing_ok=True)
        for old in {path.relative_to(folder) for pattern in stale for path in folder.glob(pattern)} - {*files}:
            (folder / old).unlink()
        for file in sorted(files, key=lambda file: file == Path(last)):
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            os.replace(temporary / file, folder / file)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if is_new:
            with contextlib.suppress(OSError):  # it holds what was moved there
                folder.rmdir()


def remove_leftovers(folder: Path, names: str) -> None:
    """Remove what processes that were killed while writing files of some names (a pattern) have left in a folder.

    A temporary file that was written to in the last `LEFTOVER_AGE_S` may be another process's work, and stays.
    """
    for leftover in folder.glob(f".{names}.*.tmp"):
        with contextlib.suppress(FileNotFoundError):  # another process has removed it, or is done
            if time.time() - leftover.stat().st_mtime > LEFTOVER_AGE_S:
                leftover.unlink()


def write_file(path: str | os.PathLike, content: bytes) -> Path:
    """Write a file at once, complete or not at all.

    Raises:
        OSError: if the place cannot be written; what was there before stays.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return Path(path)


def write_json(path: str | os.PathLike, content: Any) -> Path:
    """Write plain values as JSON, complete or not at all, with null for numbers that JSON does not know.

    Raises:
        OSError: if the place cannot be written; what was there before stays.
    """
    return write_file(path, f"{json.dumps(with_nulls(content), indent=1)}\n".encode())


def with_nulls(value: Any) -> Any:
    """Plain values, with null for numbers that JSON does not know."""
    if isinstance(value, dict):
        return {key: with_nulls(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [with_nulls(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_writable(path: str | os.PathLike, read: Iterable[str | os.PathLike | None] = ()) -> None:
    """Refuse a place that a file cannot be written to, before the work that it is to hold; nothing is left there.

    Args:
        path: the place.
        read: files that the work is made of, which it must not replace; None stands for none.

    Raises:
        OSError: naming the place and what is wrong with it.
    """
    path = Path(path)
    if path.exists() and any(s is not None and os.path.exists(s) and path.samefile(s) for s in read):
        raise FileExistsError(f"{path} is one of the files that are read; give another place for the result.")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a directory; give the name of a file.")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir():
        raise NotADirectoryError(f"{folder} is a file; give a place in a directory.")
    with _naming(path), tempfile.TemporaryFile(dir=folder):
        pass


@contextlib.contextmanager
def _naming(path: Path, instead_of: Path | None = None) -> Iterator[None]:
    """Name the place that was asked for, and not a temporary file or none, in the error of the system.

    An error that names any other file than `instead_of` is left as it is, if that is given.
    """
    try:
        yield
    except OSError as error:
        is_other = instead_of is not None and error.filename not in (None, str(instead_of), instead_of)
        if is_other or error.errno is None:
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from None


def _umask() -> int:
    """The process's mask of permissions: temporary files are private, finished ones as any other file."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
