"""Files that are complete or not there."""

import errno
import os
import stat
import tempfile
import time

import pytest

from vcjax.storage import LEFTOVER_AGE_S, check_writable, filling, replacing, write_file


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def age(path) -> None:
    """Make a file as old as one that nobody writes to any more."""
    then = time.time() - 2 * LEFTOVER_AGE_S
    os.utime(path, (then, then))


def test_writes_and_makes_folders(tmp_path):
    path = tmp_path / "a" / "b" / "note.txt"
    assert write_file(path, b"one") == path
    assert path.read_bytes() == b"one"
    write_file(str(path), b"two")
    assert path.read_bytes() == b"two" and names(path.parent) == ["note.txt"]


def test_file_has_ordinary_permissions(tmp_path):
    ordinary = tmp_path / "ordinary"
    ordinary.touch()
    assert stat.S_IMODE(write_file(tmp_path / "ours", b"").stat().st_mode) == stat.S_IMODE(ordinary.stat().st_mode)


def test_old_file_stands_until_the_new_one_is_complete(tmp_path):
    path = write_file(tmp_path / "note.txt", b"old")
    with replacing(path) as temporary:
        temporary.write_bytes(b"half of the n")
        assert path.read_bytes() == b"old" and temporary.parent == path.parent
        temporary.write_bytes(b"the new")
    assert path.read_bytes() == b"the new" and names(tmp_path) == ["note.txt"]


def test_who_reads_the_old_file_reads_it_to_its_end(tmp_path):
    path = write_file(tmp_path / "note.txt", b"old")
    with path.open("rb") as reader:
        write_file(path, b"new and longer")
        assert reader.read() == b"old"


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path, failure):
    path = write_file(tmp_path / "note.txt", b"old")

    def write_half():
        with replacing(path) as temporary:
            temporary.write_bytes(b"half")
            raise failure

    with pytest.raises(failure):
        write_half()
    assert path.read_bytes() == b"old" and names(tmp_path) == ["note.txt"]


def test_failure_to_rename_leaves_no_temporary_file(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError, match="taken"):
        write_file(tmp_path / "taken", b"")
    assert names(tmp_path) == ["taken"]


def test_what_a_killed_process_left_is_removed_and_other_files_are_not(tmp_path):
    mine, other = ".note[1].txt.abc123.tmp", ".note1.txt.abc123.tmp"
    for name in (mine, other, "note.tmp"):
        (tmp_path / name).touch()
        age(tmp_path / name)
    at_work = ".note[1].txt.def456.tmp"  # written to a moment ago: another process's
    (tmp_path / at_work).touch()
    write_file(tmp_path / "note[1].txt", b"new")
    assert names(tmp_path) == sorted([at_work, other, "note.tmp", "note[1].txt"])


def test_place_below_a_file_is_refused_in_one_line(tmp_path):
    path = write_file(tmp_path / "file", b"old")
    for place in (path / "below", path / "further" / "below"):
        for refuse in (check_writable, lambda place: write_file(place, b"")):
            with pytest.raises(OSError, match="file") as refusal:
                refuse(place)
            assert "\n" not in str(refusal.value)
    assert path.read_bytes() == b"old"


def test_writable_places_are_found_so_without_a_trace(tmp_path):
    path = write_file(tmp_path / "note.txt", b"old")
    check_writable(path)
    check_writable(tmp_path / "new" / "note.txt")
    assert path.read_bytes() == b"old" and names(tmp_path) == ["note.txt"]
    with pytest.raises(IsADirectoryError, match="is a directory; give the name of a file"):
        check_writable(tmp_path)


def test_what_is_read_is_not_written_to(tmp_path):
    path = tmp_path / "a.csv"
    check_writable(path, [path, None])  # it is not there
    path.write_text("mine")
    check_writable(tmp_path / "b.csv", [path, None, tmp_path / "c.csv"])
    (tmp_path / "link.csv").symlink_to(path)
    for place in (path, tmp_path / "link.csv"):
        with pytest.raises(FileExistsError, match=r"csv is one of the files that are read; give another place"):
            check_writable(place, [None, path])


@pytest.mark.parametrize("refuse", [check_writable, lambda place: write_file(place, b"")])
def test_refusal_of_the_system_names_the_place_that_was_asked_for(tmp_path, monkeypatch, refuse):
    def refuse_temporary(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "tmp0x1y2"))

    monkeypatch.setattr(tempfile, "mkstemp", refuse_temporary)
    monkeypatch.setattr(tempfile, "TemporaryFile", refuse_temporary)
    with pytest.raises(PermissionError, match=r"Permission denied: '.*/note.txt'") as refusal:
        refuse(tmp_path / "note.txt")
    assert "tmp0x1y2" not in str(refusal.value)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the superuser may write everywhere")
def test_unwritable_folder_is_refused(tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    for refuse in (check_writable, lambda place: write_file(place, b"")):
        with pytest.raises(PermissionError, match="locked"):
            refuse(folder / "note.txt")


def test_folder_is_filled_at_once_and_the_last_file_comes_last(tmp_path):
    folder = tmp_path / "new" / "folder"
    with filling(folder, "done.txt", ["*.old"]) as temporary:
        write_file(temporary / "done.txt", b"1")
        write_file(temporary / "a" / "b.txt", b"1")
        assert names(folder) == [temporary.name]
    assert names(folder) == ["a", "done.txt"] and names(folder / "a") == ["b.txt"]
    write_file(folder / "one.old", b"")
    write_file(folder / "mine.txt", b"mine")
    with filling(folder, "done.txt", ["*.old"]) as temporary:
        write_file(temporary / "done.txt", b"2")
        assert (folder / "done.txt").read_bytes() == b"1" and (folder / "one.old").exists()
    assert names(folder) == ["a", "done.txt", "mine.txt"] and (folder / "done.txt").read_bytes() == b"2"


def test_unfinished_folder_has_no_last_file(tmp_path, monkeypatch):
    """Killed while files move: what says that they are complete is gone first."""
    write_file(tmp_path / "done.txt", b"1")
    moved = []

    def replace(source, target):
        moved.append(target.name)
        if len(moved) == 2:
            raise KeyboardInterrupt
        os.rename(source, target)

    def fill():
        with filling(tmp_path, "done.txt", []) as temporary:
            for name in ("a.txt", "done.txt", "z.txt"):
                (temporary / name).write_bytes(b"2")
            monkeypatch.setattr(os, "replace", replace)

    with pytest.raises(KeyboardInterrupt):
        fill()
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_failure_leaves_the_folder_as_it_was(tmp_path, failure):
    write_file(tmp_path / "old" / "done.txt", b"1")

    def fill(folder):
        with filling(folder, "done.txt", ["*.txt"]) as temporary:
            write_file(temporary / "done.txt", b"2")
            raise failure

    for folder in (tmp_path / "old", tmp_path / "new"):
        with pytest.raises(failure):
            fill(folder)
    assert names(tmp_path) == ["old"] and (tmp_path / "old" / "done.txt").read_bytes() == b"1"


def test_leftovers_of_killed_fillings_go_when_they_are_old(tmp_path):
    for name in ("old", "new"):
        write_file(tmp_path / f".filling.{name}.tmp" / "a.txt", b"")
    age(tmp_path / ".filling.old.tmp")
    with filling(tmp_path, "done.txt", []):
        pass
    assert names(tmp_path) == [".filling.new.tmp"]
    write_file(tmp_path / "file", b"")
    with pytest.raises(OSError, match="is a file"), filling(tmp_path / "file", "done.txt", []):
        pass
