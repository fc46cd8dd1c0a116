"""``leaderboard submit`` and ``leaderboard verify`` as they are used, and what they never do."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import helpers_plugins
import pytest
from helpers_records import make_record
from helpers_submission import Draft
from oodd_leaderboard.reported import commands_of, read_entries

from oodd_eval.cli import main as cli
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1


def submit(submissions, root, *options):
    return cli.main(
        ["leaderboard", "submit", str(submissions.results), "--results", str(root),
         "--split", str(submissions.split), *options]
    )  # fmt: skip


def verify(submissions, *paths):
    return cli.main(
        ["leaderboard", "verify", *map(str, paths), "--split", str(submissions.split)]
    )  # fmt: skip


def test_what_is_submitted_is_valid_and_complete(submissions, tmp_path, capsys):
    assert submit(submissions, tmp_path, "--submitter", "A. Tester") == 0
    out = capsys.readouterr().out
    assert "persistence-random-small: valid, 16 cells" in out
    assert f"git add {tmp_path / 'persistence-random-small'}" in out
    assert verify(submissions, tmp_path) == 0
    (entry,) = read_entries(tmp_path)
    assert entry.meta.id == entry.path.name == "persistence-random-small"
    assert entry.meta.detectors == ["persistence", "random"]
    assert entry.meta.submitter == "A. Tester"
    assert [p["plugin"] for p in entry.meta.plugins] == ["trivial"]
    assert len(entry.records) == 16
    assert entry.curves is not None


def test_the_commands_of_an_entry_give_its_cells():
    base = make_record()
    rows = [
        replace(base, detector=detector, seed=seed, environment=environment, horizon=horizon,
                overrides=overrides)
        for detector, horizon, overrides in (
            ("rf", 1, {}), ("npn", 1, {}), ("rf", 5, {}), ("rf", 1, {"kind": "a b", "size": [1, 2]})
        )
        for seed in (1, 0) for environment in ("hopper", "ant")
    ]  # fmt: skip
    common = "oodd-eval run --detector rf --env ant,hopper --anomaly iid --split mini --seed 0,1"
    assert commands_of(rows) == [
        "oodd-eval run --detector npn,rf --env ant,hopper --anomaly iid --split mini --seed 0,1",
        common + " --horizon 5",
        common + """ --param 'kind="a b"' --param 'size=[1, 2]'""",
    ]
    whole = [replace(base, environment=e, anomaly=a) for e in ENVIRONMENTS for a in TABLE1]
    assert commands_of(whole) == [
        f"oodd-eval run --detector {base.detector} --env all --split mini --seed {base.seed}"
    ]
    (first, second) = commands_of(
        [replace(base, anomaly="iid"), replace(base, detector="npn", anomaly="drift")]
    )
    assert "npn" in first
    assert "--anomaly drift" in first
    assert "--anomaly iid" in second


@pytest.mark.parametrize("evil", ["$(rm -rf .)", "a; rm", "`rm`", "a && rm", "a\nrm"])
def test_a_value_in_a_command_is_one_word_of_a_shell(evil):
    (command,) = commands_of([replace(make_record(), overrides={"kind": evil})])
    assert shlex.split(command)[-1] == f"kind={json.dumps(evil)}"


def test_an_existing_entry_is_never_overwritten(submissions, tmp_path, capsys):
    assert submit(submissions, tmp_path, "--detector", "random") == 0
    before = sorted(p.stat().st_mtime_ns for p in tmp_path.rglob("*"))
    assert submit(submissions, tmp_path, "--detector", "random") == 4
    assert "is there already" in capsys.readouterr().err
    assert sorted(p.stat().st_mtime_ns for p in tmp_path.rglob("*")) == before


def test_a_cell_that_another_entry_has_is_refused(submissions, tmp_path, capsys):
    assert submit(submissions, tmp_path, "--detector", "random") == 0
    assert submit(submissions, tmp_path, "--id", "both") == 1
    out = capsys.readouterr().out
    assert out.count("cell: is of a row of entry random-small too") == 1
    assert re.search(r"leave it out \(and \d+ more like this\)$", out, re.MULTILINE)
    assert "nothing was written" in out
    assert [p.name for p in tmp_path.iterdir()] == ["random-small"]


def test_what_would_not_be_valid_is_not_written(submissions, tmp_path, capsys):
    assert submit(submissions, tmp_path, "--title", "<b>mine</b>") == 1
    assert "persistence-random-small: entry.json: title: is " in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["../x", "A", "a/b", ".hidden", "a..b"])
def test_an_id_is_a_plain_name(submissions, tmp_path, name, capsys):
    assert submit(submissions, tmp_path / "entries", "--id", name) == 4
    assert "--id is" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_failed_detector_can_be_submitted_with_its_reason(submissions, tmp_path, capsys):
    home = tmp_path / "out"
    shutil.copytree(submissions.results, home)
    lines = [json.loads(line) for line in (home / "records.jsonl").read_text().splitlines()]
    for line in lines:
        if line["detector"] == "random":
            line.update(
                status="error", reason="TypeError: '<' not supported\x1b", metrics={},
                per_trajectory={},
            )  # fmt: skip
    (home / "records.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    code = cli.main(
        ["leaderboard", "submit", str(home), "--results", str(tmp_path / "entries"),
         "--split", str(submissions.split)]
    )  # fmt: skip
    assert code == 0
    (entry,) = read_entries(tmp_path / "entries")
    assert {r.reason for r in entry.records if not r.ok} == {"TypeError: '(' not supported "}


def test_exit_codes_of_verify(submissions, tmp_path, capsys):
    assert verify(submissions, submissions.plain) == 0
    assert verify(submissions, tmp_path) == 5
    assert verify(submissions, tmp_path / "nowhere") == 4
    draft = Draft(submissions.plain, tmp_path)
    draft.records[0]["group"] = "dynamics"
    draft.write()
    assert verify(submissions, draft.path) == 1
    assert verify(submissions, submissions.full, draft.path) == 1
    assert "1 valid, 1 refused" in capsys.readouterr().out


def test_every_entry_of_a_directory_is_checked_and_nothing_else_may_lie_there(
    submissions, tmp_path, capsys
):
    good = Draft(submissions.plain, tmp_path)
    good.write()
    (tmp_path / "README.md").write_text("about")
    assert verify(submissions, tmp_path) == 0
    (tmp_path / "run.sh").write_text("echo")
    (tmp_path / "broken").mkdir()
    capsys.readouterr()
    assert verify(submissions, tmp_path) == 1
    out = capsys.readouterr().out
    assert "run.sh: is no entry" in out
    assert "broken: entry.json: is missing" in out
    assert "1 valid, 2 refused" in out


def test_verifying_imports_no_plugin(submissions, tmp_path, monkeypatch):
    """An entry that names a plug-in which is installed here, and would be noticed if imported."""
    site, marker = tmp_path / "site", tmp_path / "imported"
    helpers_plugins.install(
        monkeypatch, site, "evil",
        f"""
        Path({str(marker)!r}).touch()
        raise SystemExit("imported")
        """,
    )  # fmt: skip
    draft = Draft(submissions.full, tmp_path)
    draft.entry["plugins"][0].update(distribution="oodd-evil", plugin="evil")
    draft.entry["environment"]["packages"]["oodd-evil"] = "1.0"
    for record in draft.records:
        record["plugin"] = "oodd-evil:evil"
    draft.write()
    code = f"""
import sys
from importlib.metadata import entry_points
assert "evil" in entry_points(group="oodd_eval").names
from oodd_eval.cli import main as cli
arguments = ["leaderboard", "verify", {str(draft.path)!r}, "--split", {str(submissions.split)!r}]
code = cli.main(arguments)
loaded = {{name.partition(".")[0] for name in sys.modules}}
known = {{"oodd_evil", "oodd_riqn", "oodd_rf", "oodd_npn", "oodd_mewma", "torch", "sklearn"}}
print("LOADED", sorted(loaded & known), code)
"""
    path = os.pathsep.join([str(site), str(Path(cli.__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": path},
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "LOADED [] 0", done.stdout + done.stderr
    assert not marker.exists()
