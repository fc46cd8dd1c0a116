"""Twenty logs of an arm, through the commands of docs/how-to/own-data.md."""

import json
import re
import tomllib

import pytest
from helpers_docs import ROOT, Session, commands, python_blocks
from oodd_live import Watchdog

from oodd_eval import load_split

pytestmark = pytest.mark.docs

TEXT = (ROOT / "docs" / "how-to" / "own-data.md").read_text(encoding="utf-8")
SECTION = re.search(r"^## From a folder.*?(?=^## )", TEXT, re.MULTILINE | re.DOTALL)[0]
(SCRIPT,) = python_blocks(SECTION)
COMMANDS = commands(SECTION)


@pytest.fixture
def session(tmp_path, monkeypatch):
    """A directory without another split."""
    return Session(tmp_path, monkeypatch)


def test_the_page_shows_what_its_commands_print_and_finds_the_slip(session, capsys):
    exec(SCRIPT, {})  # noqa: S102
    printed = []
    for line in COMMANDS:
        assert session.run(line) == 0, line
        printed.append(capsys.readouterr().out)
    table = re.search(r"```text\nlogs: csv.*?\n\n(.*?)```", TEXT, re.DOTALL)[1]
    for line in table.splitlines()[2:]:
        assert line.rstrip() in printed[0], f"the page shows {line!r}"
    results = re.search(r"```text\ndetector(.*?)```", SECTION, re.DOTALL)[1]
    for row in results.splitlines()[2:]:
        assert " ".join(row.split()) in " ".join(printed[3].split()), f"the page shows {row!r}"
    said = " ".join(printed[0].split())
    assert re.search(r"a row every 0\.02 s in run-5\.csv", said)  # the others 0.01 s
    assert re.search(r"before row 900 of run-3\.csv", said)  # the gap
    blocks = re.findall(r"```toml\n(.*?)```", SECTION, re.DOTALL)
    (block,) = [block for block in blocks if 'split = "arm"' in block]
    assert tomllib.loads((session.directory / "arm.toml").read_text()) == tomllib.loads(block)
    lines = (session.directory / "oodd-results" / "records.jsonl").read_text().splitlines()
    records = {record["detector"]: record for record in map(json.loads, lines)}
    assert {record["status"] for record in records.values()} == {"ok"}
    pooled = {row: record["metrics"]["auc_pool"]["value"] for row, record in records.items()}
    assert pooled["mahalanobis"] > 0.75
    assert pooled["clock"] == pytest.approx(0.5, abs=0.1)
    for record in records.values():
        assert not {"auc_matched", "auc"} & {*record["metrics"]}  # which need twins


def test_the_page_shows_what_becomes_of_spoilt_files(session, capsys):
    exec(SCRIPT, {})  # noqa: S102
    logs = session.directory / "logs"
    texts = {path.name: path.read_text() for path in logs.glob("run-*.csv")}
    lines = [line.split(",") for line in texts["run-6.csv"].splitlines()]
    lines[61][3], lines[71][2] = "#N/A", "ERR 7"
    texts["run-6.csv"] = "".join(",".join(line) + "\n" for line in lines)
    texts["run-4.csv"] = texts["run-4.csv"].replace("lift[rad]", "Lift")
    texts["run-8.csv"] = texts["run-8.csv"][:-30]
    texts["run-9.csv"] = texts["run-9.csv"].replace("torque[N m]", "torque[kN m]")
    texts["run-14.csv"] = ""
    for name, text in texts.items():
        (logs / name).write_text(text)
    assert session.run(COMMANDS[0]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    block = re.search(r"```text\n(ledger .*?)```", SECTION, re.DOTALL)[1]
    for entry in re.split(r"^ledger", block, flags=re.MULTILINE)[1:]:
        assert " ".join(entry.split()) in printed
    assert session.run(COMMANDS[1]) == 0  # of the draft, which leaves spoilt files out


@pytest.mark.filterwarnings("ignore::oodd_eval.errors.PromiseWarning")  # of few recordings
def test_a_scan_names_the_gap_and_with_a_watchdog_the_slips(session):
    """Where loads slip for certain: the episodes of all six logs, and the gap of the third."""
    assert "torque -= 0.5 * fault" in SCRIPT
    exec(SCRIPT.replace("torque -= 0.5 * fault", "torque -= 5 * fault"), {})  # noqa: S102
    for line in COMMANDS[:2]:
        assert session.run(line) == 0
    Watchdog.fit("mahalanobis", load_split("arm").environment("arm"), alpha=0.1).save("watchdog")
    command = "oodd-eval scan logs --recipe arm.toml --watchdog watchdog --json scan.json"
    assert session.run(command) == 1
    episodes = json.loads((session.directory / "scan.json").read_text())["episodes"]
    faults = {e["name"].partition("#")[0]: e["faults"] for e in episodes if e["faults"]}
    odd = {e["name"].partition("#")[0] for e in episodes if e["odd"]}
    assert {name for name in odd if name.startswith("slip")} == {f"slip-{i}" for i in range(6)}
    assert [f["fault"] for f in faults["run-3"]] == ["gap"]  # which is said, and decides nothing
    assert len([name for name in odd if name.startswith("run")]) <= 3
