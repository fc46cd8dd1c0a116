"""Commands killed at random moments: what was finished stays, and the end is what it would be.

Moments follow from a seed. With ``--long``, hundreds of kills instead of thirty.
"""

import json
import random
import shutil
import sys

import pytest
from helpers_reproduce import install_quick
from helpers_robustness import KILLED, left, program, run

from oodd_eval.data.split import load_split
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

SEED = 20261123
VOLATILE = {"seconds_fit", "seconds_score", "peak_rss_mb", "provenance"}
TIMES = {"run": 14, "reproduce": 3, "fetch": 5, "build": 5}
"""How often a command is killed; others are killed once."""


def records_of(output):
    plain = [json.loads(record.to_json()) for record in ResultsDirectory(output).records()]
    return sorted(str({k: v for k, v in p.items() if k not in VOLATILE}) for p in plain)


def finished_stays(output, kept, whole):
    """Kept scores never change nor go, and records are at any moment some of the whole run's."""
    now = {f.name: f.read_bytes() for f in (output / "scores").glob("*.h5")}
    for name, content in (kept or {}).items():
        assert now.get(name) == content, f"{name} was lost or computed again"
    if (output / "records.jsonl").exists():
        assert {*records_of(output)} <= {*records_of(whole)}
    return now


def whole_or_absent(output, _kept, whole):
    """A split has its manifest last: it is the whole one, or is not there."""
    if (output / "manifest.json").exists():
        split = load_split(output)
        assert split.digest == load_split(whole).digest
        assert all(found.ok for found in split.verify())


CHECKS = {"run": finished_stays, "reproduce": finished_stays, "fetch": whole_or_absent,
          "build": whole_or_absent}  # fmt: skip


def names_below(home):
    """Files below a directory, but for logs of the run and what is kept to go on."""
    files = (p for p in home.rglob("*") if p.is_file() and "logs" not in p.parts[-3:])
    return {str(p.relative_to(home)) for p in files}


@pytest.mark.parametrize("command", KILLED)
def test_a_command_killed_at_random_ends_as_if_it_never_had_been(
    request, ground, tiny_split, tmp_path, monkeypatch, command
):
    if "--sandbox" in KILLED[command] and not shutil.which("bwrap"):
        pytest.skip("needs bubblewrap")
    if command == "reproduce":
        install_quick(monkeypatch, tmp_path / "plugins")
    words = [str(tiny_split) if word == "TINY" else word for word in KILLED[command]]
    settings = {"start": program(command), "plugins": [tmp_path / "plugins"], "limit": 300}
    check = CHECKS.get(command, lambda *_: None)
    whole = ground.copy(tmp_path / "whole")
    once = run(whole, *words, **settings)
    assert not [*once.problems], once.output
    rng, times = random.Random(SEED), TIMES.get(command, 1)
    place, kept, rounds = ground.copy(tmp_path / "killed"), None, 0
    for _ in range(30 * times if request.config.getoption("--long") else times):
        moment = rng.uniform(min(0.2, 0.1 * once.seconds), once.seconds)
        ended = run(place, *words, kill_after=moment, **settings)
        assert "Traceback" not in ended.output
        assert not [problem for problem in left(place) if problem.startswith("process")]
        kept = check(place / "out", kept, whole / "out")
        if ended.code is not None:  # it has ended by itself, and begins anew elsewhere
            assert ended.code == once.code, ended.output
            rounds += 1
            place, kept = ground.copy(tmp_path / f"killed-{rounds}"), None
    again = run(place, *words, **settings)
    # What was finished is there, and is not written once more.
    there = "exists" in again.output or "already" in again.output
    refused = command in {"export", "submit", "import"} and again.code == 4 and there
    assert again.code == once.code or refused, again.output
    assert not [*again.problems, *left(place)], again.output
    check(place / "out", kept, whole / "out")
    if not refused:
        assert names_below(place) == names_below(whole)
    if check is finished_stays:
        assert records_of(place / "out") == records_of(whole / "out")
    if command == "reproduce":
        pages = ((home / "out/README.md").read_bytes() for home in (place, whole))
        assert next(pages) == next(pages)
