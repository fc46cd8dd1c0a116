"""The command line: answers, exit codes, and what is said where."""

import contextlib
import io
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest
from click.shell_completion import ShellComplete
from helpers_plugins import install
from helpers_split import make_split
from rich.console import Console

from oodd_eval.cli import ALL, Group, info, listing
from oodd_eval.cli import main as cli
from oodd_eval.cli import run as run_module
from oodd_eval.data.bounded import read_bytes
from oodd_eval.errors import OoddError, UnknownNameError
from oodd_eval.metrics.catalogue import PAPER
from oodd_eval.scoring import display


@pytest.fixture
def run(tiny_split, tmp_path, capsys, monkeypatch):
    """Call the command line in an empty directory: exit code, standard output and error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OODD_EVAL_DATA", str(tiny_split.parent))

    def call(*arguments):
        code = cli.main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture(scope="module")
def clock(tiny_split, tmp_path_factory):
    """A directory with the results of a run of the clock; tests must not write to it."""
    place = tmp_path_factory.mktemp("clock")
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.chdir(place)
        patch.setenv("OODD_EVAL_DATA", str(tiny_split.parent))
        assert cli.main(list(CLOCK)) == 0
    (place / "printed").write_text(printed.getvalue())
    return place / "oodd-results"


CLOCK = ("run", "--detector", "clock", "--env", "cartpole", "--split", "tiny", "--jobs", "1")


def test_a_run_prints_and_writes_its_results(run, tmp_path):
    code, out, err = run(*CLOCK)
    assert (code, err) == (0, "")
    assert "split tiny, digest" in out
    assert re.search(r"^ok +cartpole/clock\[h=1,seed=0\]  matched AUC 50.0", out, re.MULTILINE)
    assert re.search(r"^8 ok in \d+\.\d s$", out, re.MULTILINE)
    assert len((tmp_path / "oodd-results" / "records.jsonl").read_text().splitlines()) == 8
    assert (
        "### Matched AUC (%) by group and environment"
        in (tmp_path / "oodd-results" / "report.md").read_text()
    )
    assert "\x1b" not in out
    assert max(map(len, out.splitlines())) <= 80
    # A second run takes over what is there, and the report has the rows of both.
    out = run(*CLOCK, "-v")[1]
    assert "8 ok (8 from earlier runs) in" in out
    assert "tiny/cartpole/iid::clock[h=1,seed=0]" in out
    assert re.fullmatch(r"8 ok in \d+\.\d s\n", run(*CLOCK, "--detector", "random", "-q")[1])
    report = (tmp_path / "oodd-results" / "report.md").read_text()
    assert "| clock " in report
    assert "| random " in report


def test_collect_only_prints_cells_and_does_nothing(run, tmp_path):
    code, out, _ = run(*CLOCK, "--collect-only", "-k", "wind or iid")
    assert code == 0
    assert out.splitlines() == [
        *(f"tiny/cartpole/{a}::clock[h=1,seed=0]" for a in ("iid", "wind-l2r", "wind-r2l")),
        "3 cells in 1 fit",
    ]
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def plugin(monkeypatch, tmp_path_factory):
    """Install a plug-in of a name and code."""

    def installed(name, code, **settings):
        install(monkeypatch, tmp_path_factory.mktemp("plugin"), name, code, **settings)

    return installed


FAILING = """
class Fails(Good):
    def score(self, x): raise RuntimeError("no")

@hookimpl
def oodd_detectors():
    return [DetectorSpec("fails", Fails, "", parameters=declared_by({"size": 5}))]
"""
FAILS = ("run", "--detector", "fails", "--env", "cartpole", "--split", "tiny")


@pytest.fixture
def failing(plugin):
    plugin("fails", FAILING)


MENDED = FAILING.replace('raise RuntimeError("no")', "return super().score(x)").replace(
    '{"size": 5}', '{"size": 5, "steps": 2}'
)


def test_a_later_attempt_replaces_a_failed_one(run, failing, plugin, tmp_path):
    code, out, _ = run(*FAILS, "-v")
    assert code == 1
    (place,) = re.findall(r"^  (oodd-results/logs/\S+\.txt):$", out, re.MULTILINE)
    assert "Traceback (most recent call last)" in (tmp_path / place).read_text()
    assert out.count("Traceback (most recent call last)") == 1
    code, out, _ = run(*FAILS)
    assert code == 1
    assert "ERROR cartpole/fails[h=1,seed=0]: RuntimeError: no" in out
    assert "Traceback" not in out
    assert run("show", "oodd-results")[0] == 1
    plugin("fails", MENDED, version="1.1")
    code, out, _ = run(*FAILS)
    assert code == 0, out
    assert "8 ok in" in out
    assert run("show", "oodd-results")[0] == 0


def test_x_stops_at_the_first_failure(run, failing):
    several = ("run", "--detector", "fails,clock", "--env", "all", "--split", "tiny", "--jobs", "1")
    code, out, _ = run(*several, "-x")
    assert code == 1
    assert re.search(r"^8 error in", out, re.MULTILINE)
    assert out.splitlines()[-1].startswith("0 of 4 fits kept; ")
    last = run(*several, "--fresh", "-q", "--env", "cartpole")[1].splitlines()[-1]
    assert last.startswith("1 of 2 fits kept; ")
    assert "without --fresh" in last


def test_a_run_without_an_extra_says_to_install_it(run, monkeypatch, plugin):
    far = 'DetectorSpec("far", Good, "", requires=("no_such",), extra="oodd-far[all]")'
    plugin("far", f"@hookimpl\ndef oodd_detectors(): return [{far}]")
    remedy = 'needs no_such: pip install "oodd-far[all]"'
    assert remedy in run("list", "detectors")[1]
    code, out, _ = run("run", "--detector", "far", "--env", "cartpole", "--split", "tiny")
    assert code == 1
    assert "8 unavailable in" in out
    assert out.count("pip install") == 1


SLOW = """
class Slow(Good):
    def fit(self, nominal, progress=None):
        super().fit(nominal)
        if progress:
            progress(0.4)
        time.sleep(1)

@hookimpl
def oodd_detectors():
    return offer(slow=Slow)
"""


@pytest.mark.parametrize(("silence", "shown"), [(0.15, True), (60, False)])
def test_a_run_says_how_far_a_long_fit_is(run, monkeypatch, plugin, silence, shown):
    plugin("slow", SLOW)
    monkeypatch.setattr(display, "SILENCE", silence)
    code, out, _ = run(*CLOCK, "--detector", "slow")
    assert code == 0
    told = re.search(r"^slow on cartpole: fitting 40 %, \d+ s$", out, re.MULTILINE)
    assert bool(told) == shown


def test_on_a_terminal_what_runs_stands_below_a_bar(run, monkeypatch, plugin):
    plugin("slow", SLOW)
    screen = Console(file=io.StringIO(), force_terminal=True, width=80, markup=False)
    monkeypatch.setattr(run_module, "make_console", lambda **_: screen)
    assert run(*CLOCK, "--detector", "slow", "--seed", "0,1")[0] == 0
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.file.getvalue())
    assert re.search(r"0/16 cells, 0:00:\d\d so far", text)
    assert re.search(r"slow\[h=1,seed=0\] on cartpole: fitting 40 %, \d+ s", text)


def test_the_time_left_is_from_cells_of_this_run_alone():
    pace = display.Pace(total=16, start=100.0)
    for _ in range(8):
        pace.add(100.1, resumed=True)
    assert math.isnan(pace.left(108.0))
    for _ in range(4):
        pace.add(140.0, resumed=False)
    assert (pace.done, pace.left(140.0), pace.left(150.0)) == (12, 40.0, 30.0)
    assert math.isnan(pace.left(200.0))  # the last ones take longer than those before
    assert str(display.Pace(16, time.perf_counter(), done=8)) == "8/16 cells, 0:00:00 so far"


def test_detectors_without_a_library_come_first_and_records_keep_their_order(run, plugin, tmp_path):
    heavy = 'DetectorSpec("heavy", Good, "", requires=("numpy",))'
    plugin("heavy", f"@hookimpl\ndef oodd_detectors(): return [{heavy}]")
    code, out, _ = run(*CLOCK, "--detector", "heavy,clock")
    assert code == 0
    assert out.index("ok           cartpole/clock") < out.index("ok           cartpole/heavy")
    lines = (tmp_path / "oodd-results" / "records.jsonl").read_text().splitlines()
    assert ['"detector": "heavy"' in line for line in lines] == [True] * 8 + [False] * 8


def test_a_broken_plugin_is_named_and_makes_exit_code_1(run, plugin):
    plugin("bad", "import no_such")
    several = ("run", "--detector", "cloc*", *CLOCK[3:])
    code, out, err = run(*several)
    assert code == 1
    assert "8 ok in" in out
    assert "plug-in 'bad' of oodd-bad is broken: ModuleNotFoundError: No module named" in err
    code, out, _ = run("list", "detectors")
    assert code == 1
    assert re.search(r"^bad +oodd-bad +\[broken plug-in\] ModuleNotFoundError", out, re.MULTILINE)
    assert run(*several, "-p", "no:bad")[0] == 0
    # A plug-in is loaded only when its detectors may be meant.
    assert run(*CLOCK)[0] == 0


KNOWS = """
class Knows(Good):
    def __init__(self, *, seed=0, horizon=1, size=5):
        super().__init__()
        self.size = size
    def score(self, x): return super().score(x) * self.size

@hookimpl
def oodd_detectors():
    one = dict(parameters=declared_by({"size": 5}))
    return [DetectorSpec(n, Knows, "", **one) for n in ("large", "small")]
"""


@pytest.mark.parametrize(
    ("arguments", "rows"),
    [
        (["--param=size=7"], ["large[h=1,seed=0,size=7]", "small[h=1,seed=0,size=7]"]),
        (["--param=small.size=2"], ["large[h=1,seed=0]", "small[h=1,seed=0,size=2]"]),
        (["--param=small.size=2", "--param=size=7"],
         ["large[h=1,seed=0,size=7]", "small[h=1,seed=0,size=2]"]),
        (["--config=c.toml"], ["large[h=1,seed=0,size=9]", "small[h=1,seed=0,size=2]"]),
        (["--detector=clock,small", "--param=small.size=2"],
         ["clock[h=1,seed=0]", "small[h=1,seed=0,size=2]"]),
        # What not all detectors have, or none, is refused with the nearest name.
        (["--detector=clock,small", "--param=size=7"], "small"),
        (["--param=smal.size=7"], "'small'"),
        (["--param=small.sise=7"], "'size'"),
    ],
)  # fmt: skip
def test_parameters_of_one_detector_of_several(run, plugin, tmp_path, arguments, rows):
    plugin("knows", KNOWS)
    (tmp_path / "c.toml").write_text("[param]\nlarge.size = 9\n'small.size' = 2\n")
    first = (*CLOCK, "--detector=large,small", "--collect-only", "--anomaly=iid")
    code, out, err = run(*first, *arguments)
    if isinstance(rows, str):
        assert (code, rows in err) == (4, True)
        return
    assert (code, err) == (0, "")
    assert [line.partition("::")[2] for line in out.splitlines()[:-1]] == rows


def test_options_come_from_a_file_and_the_command_line_wins(run, tmp_path, failing):
    (tmp_path / "run.toml").write_text(
        'detector = ["clock", "random"]\nenv = "all"\nsplit = "tiny"\nhorizon = [1, 2]\n'
        "collect-only = true\nfresh = false\n"
    )
    assert run("run", "--config", "run.toml", "-q")[1] == "64 cells in 8 fits\n"
    assert run("run", "--config", "run.toml", "--env", "hopper", "-q")[1] == "32 cells in 4 fits\n"
    (tmp_path / "run.toml").write_text(
        'detector = "fails"\nenv = "cartpole"\nsplit = "tiny"\ncollect-only = true\n'
        "[param]\nsize = 7\n"
    )
    out = run("run", "--config", "run.toml")[1]
    assert out.startswith("tiny/cartpole/iid::fails[h=1,seed=0,size=7]\n")
    assert "size=8" in run("run", "--config", "run.toml", "--param", "size=8")[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["list", "detector"], "unknown thing to list 'detector': did you mean 'detectors'?"),
        (["list", "environment"], "'environment': did you mean 'environments'?"),
        (["data", "inf"], "unknown command of data 'inf': did you mean 'info'?"),
        (["leaderbord"], "unknown command 'leaderbord': did you mean 'leaderboard'?"),
        ([*CLOCK, "--detectr", "x"], "'--detector'"),
        (["run", "--env", "cartpole"], "'--detector' (see oodd-eval run --help)"),
        ([*CLOCK, "--env", "cartpol"], "'cartpol': did you mean 'cartpole'?"),
        ([*CLOCK, "--split", "tny"], "unknown split 'tny': did you mean 'tiny'?"),
        ([*CLOCK, "--param", "size=1"], "unknown parameter of clock 'size'"),
        ([*CLOCK, "--horizon", "0"], "--horizon is '0', expected whole numbers of at least 1"),
        ([*CLOCK, "--timeout", "soon"], "--timeout is 'soon', expected a time such as"),
        ([*CLOCK, "--limit", "0"], "'--limit'"),
        ([*CLOCK, "--device", "cpu"], "none of the detectors has a device (clock)"),
        ([*CLOCK, "--device", "tpu"], "'--device'"),
        ([*CLOCK, "-k", "(iid"], "-k '(iid' cannot be read"),
        ([*CLOCK, "--detector", "clock,rf[h=1,seed=0]"], "'rf[h=1,seed=0]', the label of a row"),
        ([*CLOCK, "-p", "such"], "-p is 'such', expected no:NAME"),
        ([*CLOCK, "--config", "nowhere.toml"], "'nowhere.toml' cannot be read"),
        ([*CLOCK, "--output", "file/out"], "cannot be written to"),
        (["show", "nowhere", "--metric", "acc"], "unknown metric 'acc': did you mean 'auc'?"),
    ],
)
def test_a_wrong_request_is_exit_code_4_with_one_message(run, tmp_path, arguments, message):
    (tmp_path / "file").write_text("")
    code, out, err = run(*arguments)
    assert code == 4, err
    assert out == ""
    assert message in err
    assert err.count("\n") == 1
    assert "Traceback" not in err


def test_an_unforeseen_error_is_exit_code_3_with_a_traceback(run, monkeypatch):
    monkeypatch.setattr(listing, "rows", lambda *_: 1 / 0)
    code, _, err = run("list", "envs")
    assert code == 3
    assert "ZeroDivisionError" in err
    assert "internal error" in err
    # Of a request that is refused there is one with -v alone.
    assert "Traceback" in run(*CLOCK, "-v", "--env", "nowhere")[2]


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("can't start new thread")])
def test_without_memory_or_threads_exit_code_4_says_what_to_raise(run, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(listing, "rows", fail)
    code, _, err = run("list", "envs")
    advice = "memory or threads do not suffice: raise ulimit -v and -u, or use fewer --jobs"
    assert (code, err) == (4, f"oodd-eval: {advice}\n")


@pytest.mark.parametrize("closed", [">&-", "<&- >&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_a_run_whose_output_is_closed_does_its_work(tiny_split, tmp_path, closed):
    program = f'"$0" -m oodd_eval "$@" {closed}'
    command = [*CLOCK[:-4], "--split", str(tiny_split), "--jobs", "1"]
    done = subprocess.run(
        ["sh", "-c", program, sys.executable, *command],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    said = "oodd-eval: standard output is closed, so that nothing is printed there\n"
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == ("" if "2>&-" in closed else said)
    results = tmp_path / "oodd-results"
    records = [json.loads(line) for line in (results / "records.jsonl").read_text().splitlines()]
    assert [record["status"] for record in records] == ["ok"] * 8
    assert (results / "report.md").read_text().startswith("# ")


def test_a_small_file_takes_little_memory(tmp_path):
    """Reading at most 10^12 bytes asked for as much memory at once."""
    (tmp_path / "small").write_bytes(b"x")
    assert read_bytes(tmp_path / "small", 10**15, OoddError) == b"x"


def test_a_reader_that_leaves_ends_the_run_quietly(tiny_split, tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "oodd_eval", *CLOCK[:-4], "--split", tiny_split, "-v"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert process.wait(30) == 2
    assert err == ""


@pytest.mark.parametrize("kind", ["detectors", "envs", "anomalies", "splits", "metrics"])
def test_lists_have_one_line_each_name_first(run, kind):
    code, out, _ = run("list", kind)
    first = {line.split()[0] for line in out.splitlines()}
    expected = {"detectors": "clock", "envs": "hopper", "anomalies": "wind-l2r", "splits": "tiny",
                "metrics": "auc_matched"}  # fmt: skip
    assert code == 0
    assert expected[kind] in first


def test_lists_begin_with_what_a_newcomer_needs(run, plugin):
    plugin("mine", "@hookimpl\ndef oodd_detectors(): return offer(zzz=Good)")
    rows = [line.split(maxsplit=1) for line in run("list", "detectors")[1].splitlines()]
    assert rows[0][0] == "zzz"  # of somebody's own plug-in
    whose = {name: rest.partition("  ")[0] for name, rest in rows}
    assert whose["riqn"] == whose["rf"] == "after Danesh 2021"
    assert whose["tdqc"] == "after Francis-Meretzki 2026"
    assert whose["clock"] == "trivial"
    order = [name for name, _ in rows]
    assert order.index("riqn") < order.index("clock") < order.index("tdqc") < order.index("oracle")
    metrics = [line.split()[0] for line in run("list", "metrics")[1].splitlines()]
    assert metrics[:4] == [
        "auc_matched", "found_within_20_at_5pct", "missed_at_5pct", "false_episodes_at_5pct",
    ]  # fmt: skip


def test_show_prints_what_the_run_printed(run, clock):
    printed = (clock.parent / "printed").read_text()
    code, shown, _ = run("show", clock)
    assert code == 0
    assert "Matched AUC" in shown
    reason = "4 calibration episodes; 38 needed at 5 %"
    assert f"Undefined for clock: guaranteed alarms at 5 % ({reason})." in " ".join(shown.split())
    # What a run ends with is all that is shown.
    tables, last, rest = shown.partition("everything else: oodd-eval show ")
    assert f"\n\n{tables}{last}oodd-results --wide, oodd-results/report.md\n" in printed
    assert rest.split() == [str(clock), "--wide,", str(clock / "report.md")]
    assert "All metrics" not in shown
    wide = run("show", clock, "--wide")[1]
    assert "All metrics" in wide
    assert PAPER not in shown
    assert PAPER in wide
    assert PAPER in run("show", clock, "--paper")[1]
    assert "50.0 [50.0, 50.0]" in run("show", clock, "--intervals")[1]


def test_show_finds_a_split_that_was_named_by_its_path(run, tmp_path):
    make_split(tmp_path / "mine", name="mine")
    assert run(*CLOCK, "--split", "mine")[0] == 0
    code, out, _ = run("show", "oodd-results")
    assert code == 0
    assert out.startswith("split mine, digest ")
    assert out.splitlines()[0].endswith(f", in {tmp_path / 'mine'}")
    (tmp_path / "mine").rename(tmp_path / "moved")
    code, _, err = run("show", "oodd-results")
    assert code == 4
    assert f"it was in {str(tmp_path / 'mine')!r}, and is not there any more; pass --split" in err
    assert run("show", "oodd-results", "--split", "moved")[0] == 0
    (tmp_path / "oodd-results" / "splits.json").write_text("[1")
    code, _, err = run("show", "oodd-results")
    assert code == 4
    assert "the split 'mine' of these results is not found: unknown split 'mine'" in err
    # Another run writes the damaged file anew.
    assert run(*CLOCK, "--split", "moved")[0] == 0
    assert run("show", "oodd-results")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ("show --metric auc", "--metric"),
        ("show --csv --json", "--json --csv"),
        ("show --stored --split tiny", "--split"),
        ("show --stored --row-metrics", "--row-metrics"),
        ("show --row-metrics", "--row-metrics"),
        ("show --wide --markdown", "--wide"),
        ("show --wide --detector clock", "--wide"),
        ("show --csv --detector clock --metric auc", "--metric"),
        ("show --csv --level 10", "--level"),
        ("show --markdown --paper", "--paper"),
        ("show --detector clock --paper", "--paper"),
        ("compare --metric auc --against oodd-results", "--metric"),
        ("compare clock range --fail auc:-1", "--fail"),
        ("compare --write-reference x --two-sided", "--two-sided"),
        ("compare --against oodd-results --keep auc", "--keep"),
        ("run --detector clock --env all --split tiny --row-metrics", "--row-metrics"),
    ],
)
def test_options_that_would_do_nothing_are_refused(run, clock, arguments, options):
    command, *others = arguments.split()
    results = [] if command == "run" else ["oodd-results"]
    shutil.copytree(clock, "oodd-results")
    code, out, err = run(command, *results, *others)
    assert (code, out) == (4, "")
    assert all(option in err for option in options.split()), err
    assert err.count("\n") == 1


def test_show_recomputes_metrics_from_scores(run, clock, tmp_path):
    shutil.copytree(clock, "oodd-results")
    file = tmp_path / "oodd-results" / "records.jsonl"
    before = file.read_text()
    assert '"value": 0.5' in before
    file.write_text(before.replace("0.5", "0.9"))
    assert "90.0" in run("show", "oodd-results", "--stored", "--markdown")[1]
    assert "90.0" not in run("show", "oodd-results", "--markdown")[1]


def test_two_rows_of_one_run_are_compared(run):
    run(*CLOCK, "--detector", "clock,range")
    lines = run("show", "oodd-results", "--csv", "--detector", "range")[1].splitlines()
    assert len(lines) == 1 + 8
    assert not any(",clock," in line for line in lines)
    code, out, _ = run("compare", "oodd-results", "range", "clock")
    assert code == 0
    assert re.search(r"matched AUC: range \S+ %, clock 50.0 %, .*8 cells", out)
    assert out.startswith(("range beats clock by ", "No difference is shown "))
    code, _, err = run("compare", "oodd-results", "range")
    assert code == 4
    assert "rows 'range', expected two" in err


def test_a_failed_detector_is_forgotten(run, failing, tmp_path):
    run("run", "--detector", "fails,clock", "--env", "cartpole", "--split", "tiny")
    place = tmp_path / "oodd-results"
    logs, scores = (sorted((place / name).iterdir()) for name in ("logs", "scores"))
    assert logs
    code, out, _ = run("forget", place, "--failed")
    assert (code, out) == (0, f"8 cells removed from {place}\n")
    assert not list((place / "logs").iterdir())
    assert run("forget", place, "--failed")[0] == 5
    # Scores stay while another cell is of them.
    for expression, left in (("iid", scores), ("clock", [])):
        assert run("forget", place, "-k", expression)[0] == 0
        assert sorted((place / "scores").iterdir()) == left
    assert run("forget", place)[0] == 4


def test_verify_tells_sound_data_from_changed_data(run, tiny_split, tmp_path):
    code, out, _ = run("data", "verify", "tiny")
    assert code == 0
    assert "24 of 24 groups as they should be" in out
    own = make_split(tmp_path / "own", ("cartpole",))
    other = make_split(tmp_path / "other", ("cartpole",), seed_base=10)
    (own / "cartpole.h5").write_bytes((other / "cartpole.h5").read_bytes())
    code, out, _ = run("data", "verify", own)
    assert code == 1
    assert "1 of 12 groups" in out  # their columns have the same names
    code, _, err = run(*CLOCK, "--split", own)
    assert code == 4
    assert "does not match the manifest" in err


def test_help_is_short_and_says_what_to_do_first(capsys):
    assert cli.main([]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    first = re.search(r"^First steps:\n(.*?)\n\n", out, re.MULTILINE | re.DOTALL)[1]
    assert [line.split()[1] for line in first.splitlines()] == [
        "run", "list", "leaderboard", "scan", "calibrate", "new",
    ]  # fmt: skip
    assert [int(n) for n in re.findall(r"^  (\d)  ", out, re.MULTILINE)] == [0, 1, 2, 3, 4, 5]
    assert cli.main(["--version"]) == 0
    assert re.fullmatch(r"oodd-eval \d+\.\d+\.\d+\S*\n", capsys.readouterr().out)


def commands(group=cli.PROGRAM, context=None):
    """Yield every command with a context, its further options all shown if the root's are."""
    context = context or click.Context(group, info_name="oodd-eval", terminal_width=80)
    for name in group.entries:
        command = group.get_command(context, name)
        inner = click.Context(command, context, info_name=name)
        yield from commands(command, inner) if isinstance(command, Group) else [(command, inner)]


def test_help_of_a_command_has_at_most_14_options_and_help_all_has_every_one():
    for command, context in commands():
        text = command.get_help(context)
        has_arguments = any(isinstance(p, click.Argument) and p.help for p in command.params)
        assert text.count("\nPositional arguments:\n") == has_arguments
        brief = re.findall(r"^  (--?\w[\w-]*)", text, re.MULTILINE)
        assert len(brief) <= 14, context.command_path
        every = {p.opts[0] for p in command.get_params(context) if isinstance(p, click.Option)}
        assert {*command.further} <= every
        assert ("--help-all" in brief) == (len(every) > 14) == bool(command.further)
        context.meta[ALL] = True
        text = command.get_help(context)
        assert {*re.findall(r"^  (--?\w[\w-]*)", text, re.MULTILINE)} == every
        assert all(f"\n{heading}:\n" in text for heading in command.further.values())
        context.meta[ALL] = False


def test_further_options_are_completed_and_work(run):
    assert run("run", "--help-all")[0] == 0
    shell = ShellComplete(cli.PROGRAM, {}, "oodd-eval", cli.COMPLETION)
    assert {i.value for i in shell.get_completions(["run"], "--hor")} == {"--horizon"}
    assert run(*CLOCK, "--collect-only", "--horizon", "1,2", "-q")[1] == "16 cells in 2 fits\n"


@pytest.mark.parametrize("group", ["data", "leaderboard", "policies"])
def test_a_group_alone_prints_its_commands(run, group):
    assert run(group) == run(group, "--help")
    code, out, err = run(group)
    assert (code, err) == (0, "")
    assert "\nCommands:\n" in out


def test_environments_and_kinds_are_listed_by_either_name(run):
    assert run("list", "environments") == run("list", "envs")
    assert run("list", "kinds") == run("list", "anomalies")


@pytest.mark.parametrize(
    ("words", "completions"),
    [
        ("sh", {"show"}),
        ("data ver", {"verify"}),
        ("list en", {"envs"}),
        ("run --det", {"--detector"}),
        ("run --detector mewma,clo", {"mewma,clock"}),
        ("run --env wal", {"walker2d"}),
        ("run --config nowhere.toml --anomaly gravity,wind-l", {"gravity,wind-l2r"}),
        ("data info noisy", {"noisy-1", "noisy-5"}),
        ("show oodd-results --metric found_within_20_at_5", {"found_within_20_at_5pct"}),
        ("info hop", {"hopper"}),
        ("nonsense x", set()),
    ],
)
def test_names_are_completed(words, completions):
    *before, incomplete = words.split()
    shell = ShellComplete(cli.PROGRAM, {}, "oodd-eval", cli.COMPLETION)
    with contextlib.suppress(UnknownNameError):  # as `main` does
        assert {i.value for i in shell.get_completions(before, incomplete)} == completions
        return
    assert not completions


def test_a_shell_completes_by_the_printed_script(capsys):
    path = f"{Path(sys.executable).parent}:{os.defpath}"
    for shell in ("zsh", "fish", "bash"):
        assert cli.main(["completion", shell]) == 0
        script = capsys.readouterr().out
        assert cli.COMPLETION in script
    program = (
        f"{script}\nCOMP_WORDS=(oodd-eval lea); COMP_CWORD=1; _oodd_eval_completion oodd-eval\n"
        "echo ${COMPREPLY[@]}"
    )
    done = subprocess.run(["bash", "-c", program], env={"PATH": path}, stdout=-1, check=True)
    assert done.stdout == b"leaderboard\n"


@pytest.mark.parametrize(
    ("name", "facts"),
    [
        ("rf", [r"^detector +rf, oodd-eval ", r"trees = \d+  "]),
        ("hopper", ["15 sensors", r"torso height above its start \(m\)"]),
        ("gravity", [r"^group +dynamics$"]),
        ("standard", [r"^trajectories +500 train, 200 calibration, 50 test seeds$",
                      "not here: oodd-eval data build standard"]),
        ("missed_at_5pct", [r"^better side +lower is better$", "in at most 5 % of nominal"]),
    ],
)  # fmt: skip
def test_info_describes_whatever_has_a_name(run, name, facts):
    code, out, _ = run("info", name)
    assert code == 0
    assert all(re.search(fact, out, re.MULTILINE) for fact in facts)


def test_info_fits_a_screen_and_wide_has_the_rest(run, monkeypatch):
    code, brief, _ = run("info", "ant")
    assert code == 0
    assert re.search(
        r"^28 sensors +torso height above its start \(m\), sine of", brief, re.MULTILINE
    )
    for name in ("arm", "gravity", "payload", "panel", "rf", "mini", "worlds", "return_saved"):
        code, out, _ = run("info", name)
        assert (code, name, out.count("\n") <= 40) == (0, name, True)
    monkeypatch.setattr(info, "_detector", lambda _: ((f"p{i}", "") for i in range(60)))
    lines = run("info", "rf")[1].splitlines()
    assert (len(lines), lines[-1]) == (40, "21 more lines: oodd-eval info rf --wide")
    assert len(run("info", "rf", "--wide")[1].splitlines()) == 60


def test_info_of_a_split_is_brief_and_wide_is_its_description(run):
    code, out, _ = run("info", "tiny")
    assert code == 0
    assert re.search(r"^state +2 environments, digest [0-9a-f]{12}$", out, re.MULTILINE)
    assert re.search(r"^sensors +cartpole 4, hopper 15$", out, re.MULTILINE)
    assert run("info", "tiny", "--wide") == run("data", "info", "tiny")


def test_near_names_are_offered(run):
    near = {"gravty": "gravity", "auc_mached": "auc_matched", "tinny": "tiny", "nonsense": ""}
    for name, offered in near.items():
        code, _, err = run("info", name)
        assert code == 4
        assert (f"did you mean '{offered}'" in err) == bool(offered)
