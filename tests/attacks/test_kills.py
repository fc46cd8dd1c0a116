"""Commands killed at random moments: what was finished stays, and the end is what it would be.

Moments follow from a seed, which is printed. With ``--long``, hundreds of kills instead of thirty.
"""

import json
import os
import random
import signal
import sys
import time

import pytest
from helpers_plugins import install
from helpers_processes import environment, oodd_eval, wait_until, workers_of
from helpers_reproduce import install_quick

from oodd_eval.data.split import load_split
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

SEED = 20261123
VOLATILE = {"seconds_fit", "seconds_score", "peak_rss_mb", "provenance"}
SIMPLE = "@hookimpl\ndef oodd_detectors(): return offer(one=Good, two=Good)"


class Killing:
    """A command that is killed so many times, each at a random moment, and then resumed.

    It runs once as a whole first, into ``whole``, which tells how long it takes on this machine.
    """

    def __init__(self, times, path, *arguments, **variables):
        self.times, self.path, self.arguments = times, path, arguments
        self.marker = f"RUN={path}"
        self.variables = environment(path, path / "fits", RUN=str(path), **variables)
        begun = time.monotonic()
        self.finish(path / "whole")
        self.seconds = time.monotonic() - begun

    def start(self, output):
        words = [str(output) if word is None else str(word) for word in self.arguments]
        return oodd_eval(*words, env=self.variables, cwd=self.path, start_new_session=True)

    def finish(self, output):
        process = self.start(output)
        said, _ = process.communicate(timeout=300)
        assert process.returncode == 0, said
        return said

    def __call__(self, output, check):
        """Kill and check, again and again; a command that ends by itself begins anew elsewhere."""
        rng, killed, rounds = random.Random(SEED), 0, 0
        while killed < self.times:
            place = output.with_name(f"{output.name}-{rounds}")
            kept = None
            while killed < self.times:
                process, moment = self.start(place), rng.uniform(0.2, self.seconds)
                print(f"seed {SEED}, kill {killed} after {moment:.3f} s")  # noqa: T201
                deadline = time.monotonic() + moment
                while process.poll() is None and time.monotonic() < deadline:
                    time.sleep(0.005)
                ended = process.poll()
                os.killpg(process.pid, signal.SIGKILL) if ended is None else None
                said, _ = process.communicate()
                assert "Traceback" not in said
                assert wait_until(lambda: not workers_of(self.marker), seconds=20)
                if ended is not None:
                    assert ended == 0, said
                    break
                killed += 1
                kept = check(place, kept)
            else:
                self.finish(place)
            check(place, kept)
            rounds += 1
            yield place


def times(request, by_default, long):
    return long if request.config.getoption("--long") else by_default


def records_of(output):
    plain = [json.loads(record.to_json()) for record in ResultsDirectory(output).records()]
    return [{k: v for k, v in p.items() if k not in VOLATILE} for p in plain]


def finished_stays(whole):
    """Kept scores never change nor go, and records are at any moment some of the whole run's."""

    def check(output, kept):
        now = {f.name: f.read_bytes() for f in (output / "scores").glob("*.h5")}
        for name, content in (kept or {}).items():
            assert now.get(name) == content, f"{name} was lost or computed again"
        if (output / "records.jsonl").exists():
            assert all(record in whole for record in records_of(output))
        return now

    return check


def test_a_run_killed_at_random(request, tiny_split, tmp_path, monkeypatch):
    install(monkeypatch, tmp_path, "simple", SIMPLE)
    killing = Killing(
        times(request, 14, 250), tmp_path, "run", "-q", "--detector", "one,two", "--env", "all",
        "--anomaly", "iid,gravity", "--split", tiny_split, "--jobs", "2", "--output", None,
    )  # fmt: skip
    whole = records_of(tmp_path / "whole")
    assert len(whole) == 8
    for place in killing(tmp_path / "killed", finished_stays(whole)):
        assert records_of(place) == whole


def test_a_reproduction_killed_at_random(request, tiny_split, tmp_path, monkeypatch):
    install_quick(monkeypatch, tmp_path)
    killing = Killing(
        times(request, 3, 100), tmp_path, "reproduce", "-q", "--tier", "mini", "--split",
        tiny_split, "--only", "delays", "--jobs", "2", "--no-figures", "--output", None,
    )  # fmt: skip
    whole = records_of(tmp_path / "whole")
    for place in killing(tmp_path / "killed", finished_stays(whole)):
        # What was left comes behind what was there.
        assert sorted(map(str, records_of(place))) == sorted(map(str, whole))
        assert (place / "README.md").read_bytes() == (tmp_path / "whole/README.md").read_bytes()


SPLITS = {
    "fetch": ("fetch", "SPLIT"),
    "build": ("build", "small", "--train", "4", "--calibration", "2", "--test", "2", "--cap", "60",
              "--seed-base", "850", "--env", "cartpole", "--jobs", "1"),
}  # fmt: skip


@pytest.mark.parametrize("command", SPLITS)
def test_a_split_whose_command_was_killed_is_whole_or_absent(
    request, tiny_split, tmp_path, command
):
    """It has its manifest last."""
    pytest.importorskip("gymnasium")
    words = [tiny_split if word == "SPLIT" else word for word in SPLITS[command]]
    killing = Killing(times(request, 6, 75), tmp_path, "data", *words, "--output", None)
    digest = load_split(tmp_path / "whole").digest

    def whole_or_absent(output, _kept):
        if (output / "manifest.json").exists():
            split = load_split(output)
            assert split.digest == digest
            assert all(found.ok for found in split.verify())

    for place in killing(tmp_path / "killed", whole_or_absent):
        assert load_split(place).digest == digest
