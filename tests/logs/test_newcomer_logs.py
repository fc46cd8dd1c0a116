"""Twenty logs of an arm, through the commands of docs/how-to/own-data.md as somebody follows them.

Each command runs in a fresh directory, as on a machine that has no other split. What the page shows
and says is checked on what comes out.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from helpers_docs import commands, python_blocks

pytestmark = pytest.mark.docs

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "own-data.md"
TEXT = PAGE.read_text(encoding="utf-8")
SECTION = re.search(r"^## From a folder.*?(?=^## )", TEXT, re.MULTILINE | re.DOTALL)[0]
(SCRIPT,) = python_blocks(SECTION)
COMMANDS = commands(SECTION)


class Place:
    """A directory in which commands run as on a machine that has nothing else."""

    def __init__(self, directory):
        self.directory = directory
        directory.mkdir(parents=True)
        self.environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith(("OODD_", "PYTEST_"))},
            "HOME": str(directory / "home"),
            "XDG_DATA_HOME": str(directory / "home" / "data"),
            "COLUMNS": "120",
        }

    def run(self, *command, code=0):
        done = subprocess.run(
            command, cwd=self.directory, env=self.environment, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout

    def cli(self, line, code=0):
        words = shlex.split(line)
        assert words[0] == "oodd-eval"
        return self.run(sys.executable, "-m", "oodd_eval", *words[1:], code=code)

    def python(self, source):
        return self.run(sys.executable, "-c", source)

    def records(self):
        lines = (self.directory / "oodd-results" / "records.jsonl").read_text().splitlines()
        return {record["detector"]: record for record in map(json.loads, lines)}


def followed(directory, script=SCRIPT):
    """Run the script and the commands of the page; return the place and what was printed."""
    place = Place(directory)
    place.python(script)
    return place, {line: place.cli(line) for line in COMMANDS}


@pytest.fixture(scope="module")
def newcomer(tmp_path_factory):
    return followed(tmp_path_factory.mktemp("newcomer") / "arm")


def test_the_page_takes_five_commands():
    names = [re.sub(r"oodd-eval (data \w+|\w+).*", r"\1", line) for line in COMMANDS]
    assert names == ["data inspect", "data import", "data info", "run", "show"]


def test_inspect_sees_what_is_in_the_logs(newcomer):
    place, printed = newcomer
    assert len(list((place.directory / "logs").glob("*.csv"))) == 20
    seen = printed[COMMANDS[0]]
    table = re.search(r"```text\nlogs: csv.*?\n\n(.*?)```", SECTION, re.DOTALL)[1]
    columns = [line.split()[0] for line in table.splitlines()[2:]]
    for line in table.splitlines()[2:]:
        assert line.rstrip() in seen, f"{PAGE} shows {line!r}"
    assert columns == ["t", "turn", "lift", "torque", "northing", "gripper", "firmware", "fault"]
    said = " ".join(seen.split())
    assert re.search(r"a row every 0\.02 s in run-5\.csv", said), seen  # the others 0.01 s
    assert re.search(r"before row 900 of run-3\.csv", said), seen  # the gap


def test_the_drafted_recipe_is_that_of_the_page(newcomer):
    place, _ = newcomer
    blocks = re.findall(r"```toml\n(.*?)```", SECTION, re.DOTALL)
    (block,) = [block for block in blocks if 'split = "arm"' in block]
    assert tomllib.loads((place.directory / "arm.toml").read_text()) == tomllib.loads(block)


def test_the_import_counts_episodes(newcomer):
    """13 logs of 1000 rows at 50 Hz are 7 windows of 140 each; that with the gap is 3 and 2."""
    _, printed = newcomer
    imported = printed[COMMANDS[1]]
    nominal = [int(n) for n in re.findall(r"^(?:train|calibration|test/nominal): (\d+)", imported,
                                          re.MULTILINE)]  # fmt: skip
    assert sum(nominal) == 13 * 7 + (900 // 2) // 140 + (700 // 2) // 140
    slips = re.search(r"^test/slip: (\d+) episodes?, .* (\d+) anomalous rows", imported,
                      re.MULTILINE)  # fmt: skip
    assert int(slips[2]) == 6 * 5 * 50  # five seconds in each of six logs
    assert "firmware" in imported
    assert "northing" in imported  # the training mean is subtracted
    described = printed[COMMANDS[2]]
    assert "calibration episodes" in described
    assert "drift" in described


def test_the_run_finds_the_slip(newcomer):
    place, printed = newcomer
    records = place.records()
    assert {record["status"] for record in records.values()} == {"ok"}
    pooled = {row: record["metrics"]["auc_pool"]["value"] for row, record in records.items()}
    assert pooled["mahalanobis"] > 0.75
    assert pooled["clock"] == pytest.approx(0.5, abs=0.1)
    for record in records.values():
        assert not {"auc_matched", "auc"} & {*record["metrics"]}  # which need twins
    assert all(row in printed[COMMANDS[3]] for row in records)
    assert "pooled" in printed[COMMANDS[4]]


WATCH = """
import json, shutil
from oodd_eval import load_split
from oodd_live import Watchdog
arm = load_split("arm").environment("arm")
watchdog = Watchdog.fit("mahalanobis", arm, alpha=0.1)
shutil.rmtree("watchdog", ignore_errors=True)
watchdog.save("watchdog")
watchdog = Watchdog.load("watchdog")
alarms = {}
for part, episodes in {"nominal": arm.twins, "slip": arm.labelled("slip")}.items():
    alarms[part] = 0
    for episode in episodes:
        alarms[part] += any([reading.alarm for reading in watchdog.replay(episode)])
    alarms[part] /= len(episodes)
print(json.dumps(alarms))
"""


def test_a_scan_names_the_gap_and_with_a_watchdog_the_slips(tmp_path):
    """Where loads slip for certain: the episodes of all six logs, and the gap of the third."""
    assert "torque -= 0.5 * fault" in SCRIPT
    place = Place(tmp_path / "scanned")
    place.python(SCRIPT.replace("torque -= 0.5 * fault", "torque -= 5 * fault"))
    for line in COMMANDS[:2]:
        place.cli(line)
    place.python(WATCH)
    command = "oodd-eval scan logs --recipe arm.toml --watchdog watchdog --json scan.json"
    place.cli(command, code=1)
    episodes = json.loads((place.directory / "scan.json").read_text())["episodes"]
    odd = {e["name"].partition("#")[0]: e["faults"] for e in episodes if e["odd"]}
    assert {name for name in odd if name.startswith("slip")} == {f"slip-{i}" for i in range(6)}
    assert [f["fault"] for f in odd["run-3"]] == ["gap"]
    assert len([name for name in odd if name.startswith("run")]) <= 3


def test_a_watchdog_of_the_split_finds_slips(newcomer):
    place, _ = newcomer
    shares = json.loads(place.python(WATCH).splitlines()[-1])
    assert shares["nominal"] <= 0.25
    assert shares["slip"] >= 0.4


def test_a_northing_changes_nothing(newcomer, tmp_path):
    """Where the arm stands is a constant of 5.4e6 m, which float32 would blur by half a metre."""
    far, _ = newcomer
    assert "5.4e6 + np.cos(turn)" in SCRIPT
    near, _ = followed(tmp_path / "near", SCRIPT.replace("5.4e6 + np.cos", "np.cos"))
    for row, record in far.records().items():
        expected = near.records()[row]["metrics"]
        for metric in ("auc_pool", "auc_rows", "false_episodes_at_10pct"):
            value = record["metrics"][metric]["value"]
            assert value == pytest.approx(expected[metric]["value"], abs=0.005), (row, metric)
    assert json.loads(far.python(WATCH).splitlines()[-1]) == pytest.approx(
        json.loads(near.python(WATCH).splitlines()[-1]), abs=0.02
    )
