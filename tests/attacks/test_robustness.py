"""Commands that are given malformed files, texts that steer a terminal, and full disks.

Each case is played with ``--long``, and otherwise every so many-th of a family.
"""

import os
import signal
import socket
import sys
import threading

import helpers_robustness as robustness
import pytest

from oodd_eval.cli.main import main
from oodd_eval.data import files
from oodd_eval.errors import OutputError

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc"),
    pytest.mark.filterwarnings("default"),  # as in a command of its own
]

FAMILIES = [
    (robustness.damaged_files(), 5),
    (robustness.IMPORTS, 1),
    (robustness.CONFIGURATIONS, 1),
    (robustness.DISTRIBUTIONS, 10),
    (robustness.TERMINAL, 1),
    (robustness.FULL, 8),
]
"""Cases, and of how many one is played."""


def pytest_generate_tests(metafunc):
    if "case" in metafunc.fixturenames:
        long = metafunc.config.getoption("--long")
        cases = [case for family, every in FAMILIES for case in family[:: 1 if long else every]]
        metafunc.parametrize("case", cases, ids=lambda case: ascii(case.name))


def test_a_command_bears_what_it_is_given(case, ground, tmp_path, capfd):
    if isinstance(case, robustness.Full) and not robustness.can_mount():
        pytest.skip("mounts a file system")
    assert not case.play(ground, tmp_path / "case", capfd)


@pytest.mark.parametrize(
    ("prepare", "arguments"),
    [
        (lambda _: None, robustness.PAIRED),
        (lambda _: None, robustness.RUN),
        (robustness.onsets(b"file,onset\nrun-0.csv,20\nrun-1.csv,20\n"), robustness.ONSETS),
        (robustness.marks(b"file,start,stop\nfog/run-0.csv,10,30\nfog/run-1.csv,10,30\n"),
         robustness.RECIPE),
    ],
)  # fmt: skip
def test_what_the_cases_damage_is_sound(ground, tmp_path, capfd, prepare, arguments):
    """Otherwise cases are refused for another reason than theirs."""
    place = ground.copy(tmp_path / "sound")
    prepare(place)
    ended = robustness.run_here(place, arguments, capfd)
    assert ended.code == 0, ended.output


NAMED = [*robustness.named_files()]
assert len(NAMED) > 40


@pytest.mark.parametrize("words", NAMED, ids=lambda words: " ".join(words[0]))
def test_what_is_no_plain_file_is_refused_wherever_a_file_is_named(
    words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind("socket")
    signal.alarm(60)
    try:
        for path in ("pipe", "socket", "/dev/zero"):
            assert main(robustness.naming(words, path)) == 4
            _, said = capsys.readouterr()
            assert said.count("\n") <= 3
            assert "Traceback" not in said
    finally:
        signal.alarm(0)


def test_two_writers_do_not_meet(tmp_path):
    held, done = threading.Event(), threading.Event()

    def hold():
        with files.only_writer(tmp_path / "out"):
            held.set()
            done.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    assert held.wait(60)
    with pytest.raises(OutputError, match="another process"), files.only_writer(tmp_path / "out"):
        pass
    done.set()
    thread.join()
    with files.only_writer(tmp_path / "out"):
        pass


def test_what_a_killed_process_left_goes_with_the_next_use(tmp_path):
    ended = 2**22 + 1  # above the largest number of a process
    for name in (f".mine.{ended}", f".mine.0a.{ended}"):
        (tmp_path / name).mkdir()
    (tmp_path / f".file.txt.{ended}").write_text("half")
    kept = [tmp_path / f".mine.{os.getpid()}", tmp_path / f".other.{ended}"]
    for path in kept:
        path.mkdir()
    with files.temporary_directory(tmp_path, "mine") as directory:
        assert directory.is_dir()
    files.write_text(tmp_path / "file.txt", "whole")
    assert {*tmp_path.iterdir()} == {*kept, tmp_path / "file.txt"}
