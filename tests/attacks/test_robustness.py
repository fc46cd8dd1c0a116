"""A sample of the cases that ``benchmarks/robustness.py`` plays and counts; all with --long."""

import os
import random
import signal
import socket
import sys
import threading

import helpers_robustness as robustness
import pytest

from oodd_eval.cli.main import main
from oodd_eval.data import files
from oodd_eval.errors import OutputError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

FAMILIES = {
    "files": (robustness.damaged_files(999), 8),
    "logs": (robustness.IMPORTS, 8),
    "pipes": (robustness.pipes(), 2),
    "configurations": (robustness.CONFIGURATIONS, 5),
    "metadata": (robustness.DISTRIBUTIONS, 6),
    "terminal": (robustness.TERMINAL, 12),
    "kills": (robustness.kills(40), 4),
    "full disks": (robustness.FULL, 4),
    "hostile": (robustness.hostile_runs(size=6), 3),
}


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    return robustness.Ground(tmp_path_factory.mktemp("ground"))


@pytest.mark.parametrize("family", FAMILIES)
def test_commands_bear_what_they_are_given(request, ground, tmp_path, family):
    if family == "full disks" and not robustness.can_mount():
        pytest.skip("mounts a file system")
    cases, number = FAMILIES[family]
    if not request.config.getoption("--long"):
        cases = random.Random(5).sample(cases, number)
    problems = {}
    for i, case in enumerate(cases):
        if "sandbox" in case.name and not os.path.exists("/usr/bin/bwrap"):  # noqa: PTH110
            continue
        problems[case.name] = case.play(ground, tmp_path / f"case-{i}")
    assert not {name: found for name, found in problems.items() if found}


def test_what_the_cases_damage_is_sound(ground, tmp_path):
    """Otherwise cases are refused for another reason than theirs."""
    prepared = [(lambda _: None, RECIPE) for RECIPE in (robustness.PAIRED, robustness.RUN)]
    prepared += [
        (robustness.onsets(b"file,onset\nrun-0.csv,20\nrun-1.csv,20\n"), robustness.ONSETS),
        (robustness.marks(b"file,start,stop\nfog/run-0.csv,10,30\nfog/run-1.csv,10,30\n"),
         robustness.RECIPE),
    ]  # fmt: skip
    for i, (prepare, arguments) in enumerate(prepared):
        place = ground.copy(tmp_path / str(i))
        prepare(place)
        ended = robustness.run(place, *arguments)
        assert ended.code == 0, ended.output


NAMED = [*robustness.named_files()]


def test_many_options_name_files():
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
