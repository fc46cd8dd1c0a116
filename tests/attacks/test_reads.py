"""What one sandbox has read is no faster to read for the next one."""

import os

import pytest

from oodd_eval.plugins.isolation.reads import Reads


def in_memory(path):
    """Tell whether the first page of a file lies in memory; to look at it brings it there."""
    with path.open("rb", buffering=0) as file:
        try:
            return bool(os.preadv(file.fileno(), [bytearray(1)], 0, os.RWF_NOWAIT))
        except BlockingIOError:
            return False


@pytest.fixture
def files(tmp_path):
    """Files on a disk, of which nothing is in memory."""
    paths = [tmp_path / "a", tmp_path / "in" / "b", tmp_path / "single"]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes(2**16))
        with path.open("rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    if in_memory(paths[0]):
        pytest.skip("the file system has no cache that can be asked")
    return paths


@pytest.mark.parametrize("which", ["directory", "file", "blind"])
def test_what_was_read_is_forgotten(files, which, monkeypatch):
    path = files[2] if which == "file" else files[1]
    reads = Reads([files[2]] if which == "file" else [files[0].parent])
    if which == "blind":  # as where there are too many directories to look at
        reads.close()
        reads = Reads([files[0].parent])
        reads._blind = True
    for _ in range(2):
        with reads.forgotten():
            path.read_bytes()
            assert in_memory(path)
        assert not in_memory(path)
    reads.close()


def test_what_another_has_open_is_forgotten_at_its_end_too(files):
    reads = Reads([files[0].parent])
    with reads.forgotten(), files[1].open("rb") as file:
        with reads.forgotten():
            file.read()
        assert not in_memory(files[1])
        file.seek(0)
        file.read()
        assert in_memory(files[1])
    assert not in_memory(files[1])
    assert not reads._opened
    reads.close()


def test_more_openings_than_the_system_keeps_are_seen(tmp_path):
    """Otherwise all files of the system are opened at every end of a group, for minutes."""
    (tmp_path / "file").write_bytes(b"1")
    (tmp_path / "other").write_bytes(b"1")
    reads = Reads([tmp_path])
    for name in ("file", "other") * 25_000:  # the same one twice would count once
        os.close(os.open(tmp_path / name, os.O_RDONLY))
    assert not reads._missed
    with reads._lock:
        reads._forget()
    assert {*reads._opened} == {str(tmp_path / "file"), str(tmp_path / "other")}
    reads.close()


@pytest.mark.parametrize("which", ["_blind", "_missed"])
def test_what_was_not_seen_is_forgotten_without_being_counted_as_opened(tmp_path, which):
    for i in range(2500):
        (tmp_path / f"{i}").touch()
    reads = Reads([tmp_path])
    setattr(reads, which, True)
    (tmp_path / "7").read_bytes()
    with reads._lock:
        reads._forget()
    assert {*reads._opened} == {str(tmp_path / "7")}
    assert (reads._blind, reads._missed) == (which == "_blind", False)
    reads.close()
