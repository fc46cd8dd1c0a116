"""``oodd-eval reproduce`` as a whole: a small split, quick detectors in the paper's names."""

import csv
import json
import random
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers_reproduce import install_quick
from oodd_paper import reproduction_page as pages
from oodd_paper.dot_plots import Dots, Panel, Picture, draw, drawing_key
from oodd_paper.experiments import Grid

from oodd_eval.cli.main import main
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.slow

ONLY = "delays"
"""Five units in each environment, riqn at three horizons."""


@pytest.fixture
def quick(monkeypatch, tmp_path):
    install_quick(monkeypatch, tmp_path / "plugins")


def reproduce(split, output, *options, only=ONLY):
    """Without figures, which take longer than all the rest."""
    return main(
        ["reproduce", "--tier", "mini", "--split", str(split), "--output", str(output),
         "--only", only, "--no-figures", *options]
    )  # fmt: skip


def contents(directory):
    """Everything a reader sees, by name: not scores, logs, and where the split was."""
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in sorted(Path(directory).rglob("*"))
        if path.is_file()
        and path.parts[len(Path(directory).parts)] not in ("scores", "logs", "splits.json")
    }


def render(directory, *options):
    return main(
        ["reproduce", "--render-only", "--output", str(directory), "--no-figures", "-q", *options]
    )


@pytest.fixture(scope="module")
def finished(tiny_split, tmp_path_factory):
    """A directory in which the delays are finished; tests must not change it."""
    with pytest.MonkeyPatch.context() as patch:
        install_quick(patch, tmp_path_factory.mktemp("plugins"))
        output = tmp_path_factory.mktemp("finished") / "reproduction"
        assert reproduce(tiny_split, output) == 0
    return output


def test_files_of_a_reproduction_hold_numbers_of_its_records(finished):
    names = set(contents(finished))
    files = {"README.md", "claims.csv", "records.jsonl", "reproduction.json", "returns.json"}
    assert files <= names
    for name in ("table-2", "figure-horizon", "delays"):
        assert {f"tables/{name}.md", f"tables/{name}.csv"} <= names
    page = (finished / "README.md").read_text()
    assert "10 of 90 fits and scorings have been run." in page
    # Ensembles share no setup but RIQN's with the delays; N-RIQN was not run at all.
    assert "not run" in (finished / "tables" / "table-3.md").read_text()
    assert "(2 of 7)" in page
    records = [r for r in ResultsDirectory(finished).records()
               if (r.environment, r.horizon) == ("hopper", 10)]  # fmt: skip
    sensor = [r.value("delay_censored") for r in records if r.group == "sensor"]
    with (finished / "tables" / "delays.csv").open(newline="") as file:
        [row] = [
            r for r in csv.DictReader(file)
            if (r["environment"], r["horizon"], r["anomalies"], r["metric"])
            == ("hopper", "10", "sensor", "delay_censored")
        ]  # fmt: skip
    assert float(row["value"]) == pytest.approx(np.mean(sensor), rel=1e-5)


def test_a_second_run_does_nothing_and_changes_no_byte(finished, tiny_split, quick, capsys):
    before = contents(finished)
    times = {p: p.stat().st_mtime_ns for p in finished.rglob("*") if p.is_file()}
    assert reproduce(tiny_split, finished) == 0
    assert "[1/" not in capsys.readouterr().out
    assert contents(finished) == before
    assert times == {p: p.stat().st_mtime_ns for p in finished.rglob("*") if p.is_file()}


def test_tables_and_figures_are_made_again_from_the_records_alone(
    finished, tmp_path, monkeypatch, quick, capsys
):
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "nowhere"))
    kept = tmp_path / "kept"
    kept.mkdir()
    for name in ("records.jsonl", "reproduction.json", "returns.json"):
        shutil.copy(finished / name, kept / name)
    assert render(kept) == 0
    assert contents(kept) == contents(finished)
    header = kept / "reproduction.json"
    plain = json.loads(header.read_text())
    plain["tier"]["limit"] = None  # which an earlier version wrote
    header.write_text(json.dumps(plain))
    assert render(kept) == 0
    assert (kept / "README.md").read_bytes() == (finished / "README.md").read_bytes()
    header.write_text(header.read_text()[:-20])
    assert render(kept) == 4
    assert "reproduction.json" in capsys.readouterr().err
    # One directory holds one reproduction.
    assert main(["reproduce", "--tier", "mini", "--output", str(finished)]) == 4
    message = capsys.readouterr().err
    assert "split tiny" in message
    assert "--output" in message


def test_tables_are_made_from_records_that_lie_elsewhere_in_any_order(finished, tmp_path, capsys):
    """Entries of the leaderboard hold the records, and other things beside them."""
    kept, entries = tmp_path / "kept", tmp_path / "entries"
    kept.mkdir()
    for name in ("reproduction.json", "returns.json"):
        shutil.copy(finished / name, kept / name)
    lines = (finished / "records.jsonl").read_text().splitlines(keepends=True)
    random.Random(0).shuffle(lines)
    others = [line.replace('"split_digest": "', '"split_digest": "0') for line in lines]
    for name, part in (("a", lines[:30]), ("b/c", lines[30:]), ("d", others)):
        (entries / name).mkdir(parents=True)
        (entries / name / "records.jsonl").write_text("".join(part))
    assert render(kept, "--records", str(entries)) == 0
    mine, theirs = contents(kept), contents(finished)
    assert mine | {"records.jsonl": theirs["records.jsonl"]} == theirs
    (entries / "d" / "records.jsonl").write_text(lines[0])
    assert render(kept, "--records", str(entries)) == 4
    message = capsys.readouterr().err
    assert str(entries / "a") in message
    assert str(entries / "d") in message
    assert render(kept, "--records", str(kept)) == 4


def test_figures_are_drawn_once_and_again_when_numbers_change(finished, tmp_path, monkeypatch):
    def in_name_only(picture):
        return {"png": b"a picture", "svg": drawing_key(picture).encode()}

    monkeypatch.setattr(pages, "draw", in_name_only)
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    assert main(["reproduce", "--render-only", "--output", str(copy), "-q"]) == 0
    pictures = {p: p.stat().st_mtime_ns for p in (copy / "figures").iterdir()}
    names = {"table-2", "table-3", "table-4", "table-5", "controls", "delays", "figure-models",
             "figure-horizon", "figure-horizon-matched", "figure-samples",
             "figure-samples-matched"}  # fmt: skip
    assert {p.name for p in pictures} == {f"{n}.{s}" for n in names for s in ("png", "svg")}
    page = (copy / "README.md").read_text()
    assert all(f"](figures/{name}.png)" in page for name in names)

    records = copy / "records.jsonl"
    lines = records.read_text().splitlines(keepends=True)
    records.write_text("".join(line for line in lines if '"horizon": 20' not in line))
    (copy / "figures" / "table-2.png").unlink()
    assert main(["reproduce", "--render-only", "--output", str(copy), "-q"]) == 0
    changed = {p.stem for p, t in pictures.items() if p.stat().st_mtime_ns != t}
    assert {"table-2", "delays", "figure-horizon"} <= changed
    assert not {"table-4", "table-5", "controls", "figure-samples"} & changed


def test_a_budget_that_is_used_up_leaves_units_and_says_so(tiny_split, quick, tmp_path, capsys):
    assert reproduce(tiny_split, tmp_path / "out", "--budget", "0.001s") == 2
    said = capsys.readouterr().out
    # A unit that was begun may end before the budget is looked at.
    assert re.search(r"the budget is used up: \d+ units left", said)
    page = (tmp_path / "out" / "README.md").read_text()
    assert re.search(r"\b[0-8] of 90 fits and scorings have been run\.", page)
    assert "**Unfinished**" in page
    assert "not run |" in page


def test_the_plan_says_what_remains_and_does_nothing(finished, tiny_split, quick, tmp_path, capsys):
    assert reproduce(tiny_split, tmp_path / "out", "--plan") == 0
    said = capsys.readouterr().out
    assert "What remains" in said
    [line] = [line for line in said.splitlines() if line.startswith("all ")]
    assert line.split()[1:4] == ["10", "0", "10"]
    assert not (tmp_path / "out").exists()
    assert reproduce(tiny_split, finished, "--plan") == 0
    [line] = [x for x in capsys.readouterr().out.splitlines() if x.startswith("all ")]
    assert line.split()[1:4] == ["10", "10", "0"]


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (["--tier", "mimi"], "did you mean 'mini'"),
        (["--tier", "mini", "--only", "table-6"], "unknown table or figure 'table-6'"),
        (["--tier", "mini", "--budget", "soon"], "a time such as"),
        (["--tier", "mini", "--jobs", "0"], "'--jobs'"),
        (["--tier", "mini", "--device", "tpu"], "'--device'"),
        (["--tier", "mini", "--records", "x"], "--records is what --render-only reads"),
        (["--render-only"], "no reproduction in"),
        ([], "oodd-eval data build standard"),
    ],
)
def test_wrong_requests_are_refused_before_any_work(
    quick, tmp_path, monkeypatch, capsys, options, part
):
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path))
    output = tmp_path / "out"
    assert main(["reproduce", "--output", str(output), *options]) == 4
    assert part in capsys.readouterr().err
    assert not output.exists()


def test_failing_units_are_states_and_the_exit_code_is_one(
    tiny_split, quick, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("QUICK_SECONDS", "30")
    output = tmp_path / "out"
    code = reproduce(tiny_split, output, "--timeout", "1s", "--jobs", "5", only="delays")
    assert code == 1
    assert "timeout" in (output / "tables" / "delays.md").read_text()
    assert "## Failures" in (output / "README.md").read_text()
    assert "timeout" in capsys.readouterr().out


def a_figure(**changes):
    dots = Dots(
        "RIQN", (50.0, float("nan")), (40.0, float("nan")), (60.0, float("nan")), (55.0,) * 2
    )
    panel = Panel("One", "AUC (%)", ("a", "b"), (dots,), 50.0)
    return Picture("A figure", (panel,), Grid(columns=1, **changes))


def test_figures_are_the_same_bytes_again_without_date_or_version():
    first, second = draw(a_figure()), draw(a_figure())
    assert first == second
    # By which a figure is known that need not be drawn again.
    assert drawing_key(a_figure()).encode() in first["svg"][:4000]
    assert first["png"].startswith(b"\x89PNG")
    assert b"<dc:date>" not in first["svg"]
    assert b"Software" not in first["png"]
    assert draw(a_figure(height=3.0)) != first
    text = first["svg"].decode()
    assert all(word in text for word in ("A figure", "One", "RIQN", "AUC (%)", "hollow"))
