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


@pytest.fixture(scope="module")
def newcomer(tmp_path_factory):
    """A place where the script and the commands of the page have run, and what was printed."""
    place = Place(tmp_path_factory.mktemp("newcomer") / "arm")
    place.python(SCRIPT)
    return place, {line: place.cli(line) for line in COMMANDS}


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
from oodd_eval import load_split
from oodd_live import Watchdog
arm = load_split("arm").environment("arm")
Watchdog.fit("mahalanobis", arm, alpha=0.1).save("watchdog")
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
