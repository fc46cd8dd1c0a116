"""Strangers' entries in a season: what fails is a row with its reason, and no cheat gains."""

import shutil
import sys
from pathlib import Path

import adversaries
import numpy as np
import pytest
from helpers_entries import write_entry, write_plugin_entry, write_wheel
from helpers_plugins import table_of
from oodd_leaderboard.season_files import read_season
from oodd_leaderboard.standings import ordered

from oodd_eval.cli.main import main

pytestmark = [
    pytest.mark.attacks,
    pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap"),
]
pytest.importorskip("gymnasium")

OFFER = """
class Mine(Good):
    {methods}

@hookimpl
def oodd_detectors():
    return [DetectorSpec("{name}", Mine, "a stranger's", deterministic=True, {facts})]
"""


def offer(name, methods="pass", facts=""):
    return OFFER.format(name=name, methods=methods, facts=facts)


def season(directory, entries, *arguments):
    words = ("leaderboard", "season", "--entries", entries, "--output", directory, *arguments)
    return main([*map(str, words)])


# What fails

FAILING = {
    "altered": (offer("altered"), {"sha256": "0" * 64}, "unavailable", "sha256"),
    "broken": ("raise RuntimeError('no such day')\n", {}, "error", "no such day"),
    "nameless": (offer("other"), {}, "error", "nameless"),
    "crash": (offer("crash", "def fit(self, nominal): os._exit(7)"), {}, "error", "7"),
    "lacks": (offer("lacks", facts="requires=('no_such_module',)"), {}, "unavailable",
              "no_such_module"),
    "seeded": (offer("seeded"), {}, "error", "seed"),
}  # fmt: skip


@pytest.fixture(scope="module")
def failed(tmp_path_factory):
    """Records of a small season by entry."""
    home = tmp_path_factory.mktemp("failing")
    for name, (code, settings, *_) in FAILING.items():
        lines = ["parameters = {seed = 17}"] if name == "seeded" else []
        write_plugin_entry(home / "entries", name, code, *lines, **settings)
    write_plugin_entry(home / "entries", "sound", offer("sound"))
    (home / "entries" / "clock.toml").write_text("")
    sizes = ("--env", "cartpole", "--train", 2, "--calibration", 2, "--test", 2, "--cap", 60)
    assert season(home / "season", home / "entries", *sizes) == 1
    read = read_season(home / "season")
    records = read.records(home / "season")
    assert read.missing(records) == []
    assert [w.distribution for w in read.installed["sound"]] == ["oodd-sound"]
    return {name: [r for r in records if r.detector == name] for name in read.entries}


@pytest.mark.parametrize("name", FAILING)
def test_an_entry_that_fails_is_a_row_with_its_reason(failed, name):
    *_, status, reason = FAILING[name]
    assert {r.status for r in failed[name]} == {status}, failed[name][0].reason
    assert reason in failed[name][0].reason


def test_rows_beside_those_that_fail_are_run(failed):
    assert all(r.ok for r in failed["sound"]), failed["sound"][0].reason
    assert all(r.ok for r in failed["clock"])


# Cheats

HONEST = "honest"
CHEATS = {
    "table": "sly-memorised",
    "future": "sly-look-ahead",
    "prefixes": "sly-look-ahead-prefix",
    "files": "sly-company-home",
    "variables": "sly-company-environment",
    "globals": "sly-company-module",
    "lucky": "sly-lucky",
}
SIZES = ("--env", "cartpole,tank", "--train", 3, "--calibration", 8, "--test", 4, "--cap", 60)

RUNS = "import os; os.path.isdir({home!r}) and open({home!r} + '/ran', 'a').write('ran')\n"

MORE = """
class Lucky(Honest):
    '''The seed that was best of thirty on episodes of its author's.'''
    def reset(self):
        super().reset()
        self.draws_ = np.random.default_rng(17)
    def bent(self, row, score):
        return self.draws_.normal()

ADVERSARIES["sly-lucky"] = Lucky
"""

NEAR = """
class Near(Honest):
    def bent(self, row, score):
        return score * (1 + 1e-9)

@hookimpl
def oodd_detectors():
    return [DetectorSpec("near", Near, "a copy", deterministic=True)]
"""


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """The season of an honest row and of cheats that hide it, and a file that nothing writes."""
    home = tmp_path_factory.mktemp("cheats")
    marker = home / "ran"
    runs = RUNS.format(home=str(home))
    source = Path(adversaries.__file__).read_text()
    files = {
        "oodd_sly.py": runs + source + MORE,
        "oodd_adversaries_table.py": table_of("mini"),
        # What Python itself imports when it starts, and a module that shadows its own.
        "sitecustomize.py": runs,
        "usercustomize.py": runs,
        "secrets.py": f"{runs}randbits = lambda n: 0\n",
        "sly.pth": runs,
    }
    wheel = write_wheel(home, "oodd-sly", files, plugin="sly", module="oodd_sly")
    entries = home / "entries"
    write_entry(entries, HONEST, wheel, 'detector = "sly-honest"')
    for name, detector in CHEATS.items():
        lines = [f'detector = "{detector}"', "variant = true"]
        write_entry(entries, name, wheel, *lines)
    near = source.partition("@hookimpl")[0] + NEAR
    copy = write_wheel(home, "oodd-near", {"oodd_near.py": near}, plugin="near", module="oodd_near")
    write_entry(entries, "near", copy)
    # Records of its author's own, which a season does not read.
    (entries / "lucky" / "records.jsonl").write_text('{"auc_matched": 1.0}\n')
    assert season(home / "season", entries, *SIZES) == 0
    read = read_season(home / "season")
    return read, read.records(home / "season"), marker


@pytest.mark.parametrize("name", [*CHEATS, "near"])
def test_no_cheat_gains_against_the_row_that_it_hides(played, name):
    _, records, _ = played
    honest = {r.position: r for r in records if r.detector == HONEST}
    mine = [r for r in records if r.detector == name]
    assert {r.position for r in mine} == {*honest}
    assert all(record.ok for record in mine), mine[0].reason
    values = [record.value("auc_matched") for record in mine]
    if name == "lucky":  # it hides no row: its draws know nothing of these episodes
        assert np.mean(values) == pytest.approx(0.5, abs=0.1)
    else:
        expected = [honest[record.position].value("auc_matched") for record in mine]
        assert values == pytest.approx(expected, abs=0.005)


def test_a_copy_pushes_the_row_that_it_copies_to_no_lower_rank(played):
    read, records, _ = played
    board = ordered(records, read.entries, expected=read.expected)
    ranks = {standing.entry.detector: standing.rank for standing in board.standings}
    assert ranks["near"] == ranks[HONEST] == 1
    assert all(ranks[name] is None for name in CHEATS)  # variants


def test_nothing_of_a_strangers_wheel_runs_in_the_command(played):
    read, _, marker = played
    assert not marker.exists()
    assert int(read.bits, 16) != 0
    assert not {"oodd_sly", "oodd_near", "sitecustomize_of_sly"} & {*sys.modules}
    assert "sly" not in str(sys.modules.get("secrets"))
