"""The command line: answers, exit codes, and what is said where."""

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers_docs import parse
from helpers_plugins import install
from helpers_split import make_split

from oodd_eval import cli as cli_package
from oodd_eval.cli import listing
from oodd_eval.cli import main as cli
from oodd_eval.errors import MissingExtraError
from oodd_eval.metrics.catalogue import PAPER


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


BUILD = ["data", "build", "dev", "--train=1", "--calibration=1", "--test=1", "--seed-base=90"]
CLOCK = ("run", "--detector", "clock", "--env", "cartpole", "--split", "tiny", "--jobs", "1")


def test_a_run_prints_and_writes_its_results(run, tmp_path):
    code, out, err = run(*CLOCK)
    assert (code, err) == (0, "")
    assert "split tiny, digest" in out
    assert re.search(r"^ok +cartpole/clock\[h=1,seed=0\]  matched AUC 50.0", out, re.MULTILINE)
    assert re.search(r"^8 ok in \d+\.\d s$", out, re.MULTILINE)
    assert len((tmp_path / "oodd-results" / "records.jsonl").read_text().splitlines()) == 8
    assert "### Separability: matched AUC" in (tmp_path / "oodd-results" / "report.md").read_text()
    assert "\x1b" not in out
    assert max(map(len, out.splitlines())) <= 80
    # A second run takes over what is there, and the report has the rows of both.
    assert "8 ok (8 from earlier runs) in" in run(*CLOCK)[1]
    assert "clock" not in run(*CLOCK, "--detector", "random")[1]
    report = (tmp_path / "oodd-results" / "report.md").read_text()
    assert "| clock " in report
    assert "| random " in report


def test_quiet_and_verbose(run):
    assert re.fullmatch(r"8 ok in \d+\.\d s\n", run(*CLOCK, "-q")[1])
    assert "ok           tiny/cartpole/iid::clock[h=1,seed=0]" in run(*CLOCK, "-v")[1]
    assert "Traceback" in run(*CLOCK, "-v", "--env", "nowhere")[2]


def test_collect_only_prints_cells_and_does_nothing(run, tmp_path):
    code, out, _ = run(*CLOCK, "--collect-only", "-k", "wind or iid")
    assert code == 0
    assert out.splitlines() == [
        *(f"tiny/cartpole/{a}::clock[h=1,seed=0]" for a in ("iid", "wind-l2r", "wind-r2l")),
        "3 cells in 1 fits",
    ]
    assert list(tmp_path.iterdir()) == []


FAILING = """
class Fails(Good):
    def score(self, x): raise RuntimeError("no")

@hookimpl
def oodd_detectors():
    return [DetectorSpec("fails", Fails, "", parameters=declared_by({"size": 5}))]
"""


@pytest.fixture
def failing(monkeypatch, tmp_path_factory):
    install(monkeypatch, tmp_path_factory.mktemp("plugin"), "fails", FAILING)


MENDED = FAILING.replace('raise RuntimeError("no")', "return super().score(x)").replace(
    '{"size": 5}', '{"size": 5, "steps": 2}'
)


def test_a_later_attempt_replaces_a_failed_one(run, failing, monkeypatch, tmp_path_factory):
    selected = ("run", "--detector", "fails", "--env", "cartpole", "--split", "tiny")
    code, out, _ = run(*selected)
    assert code == 1
    assert "ERROR cartpole/fails[h=1,seed=0]: RuntimeError: no" in out
    assert run("show", "oodd-results")[0] == 1
    install(monkeypatch, tmp_path_factory.mktemp("mended"), "fails", MENDED, version="1.1")
    code, out, _ = run(*selected)
    assert code == 0, out
    assert re.search(r"^8 ok in", out, re.MULTILINE)
    assert "ERROR" not in out
    assert "8 ok\n" in run("show", "oodd-results")[1]
    assert run("show", "oodd-results")[0] == 0


def test_verbose_prints_the_log_of_a_failed_unit_with_its_place(run, failing, tmp_path):
    selected = ("run", "--detector", "fails", "--env", "cartpole", "--split", "tiny")
    _, out, _ = run(*selected, "-v")
    (place,) = re.findall(r"^  (oodd-results/logs/\S+\.txt):$", out, re.MULTILINE)
    assert "Traceback (most recent call last)" in (tmp_path / place).read_text()
    assert out.count("Traceback (most recent call last)") == 1
    assert "Traceback" not in run(*selected)[1]


def test_x_stops_at_the_first_failure(run, failing):
    code, out, _ = run(
        "run", "--detector", "fails,clock", "--env", "all", "--split", "tiny", "--jobs", "1", "-x"
    )
    assert code == 1
    assert re.search(r"^8 error in", out, re.MULTILINE)


def test_a_broken_plugin_is_named_and_makes_exit_code_1(run, monkeypatch, tmp_path_factory):
    install(monkeypatch, tmp_path_factory.mktemp("plugin"), "bad", "import no_such")
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


def test_an_unavailable_detector_is_listed_with_the_command_and_fails_when_run(
    run, monkeypatch, tmp_path_factory
):
    code = """
    @hookimpl
    def oodd_detectors():
        return [DetectorSpec("far", Good, "", requires=("no_such",), extra="oodd-far[all]")]
    """
    install(monkeypatch, tmp_path_factory.mktemp("plugin"), "far", code)
    assert (
        '[unavailable: needs no_such: pip install "oodd-far[all]"]' in run("list", "detectors")[1]
    )
    code, out, _ = run("run", "--detector", "far", "--env", "cartpole", "--split", "tiny")
    assert code == 1
    assert "8 unavailable in" in out


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
        (["data", "bild"], "unknown command of data 'bild': did you mean 'build'?"),
        (["list", "detector"], "unknown thing to list 'detector': did you mean 'detectors'?"),
        (["data"], "(see oodd-eval data --help)"),
        ([*CLOCK, "--detectr", "x"], "'--detector'"),
        (["run", "--env", "cartpole"], "'--detector' (see oodd-eval run --help)"),
        (["leaderboard", "submit", "x", "--primary"], "--primary"),
        ([*CLOCK, "--env", "cartpol"], "'cartpol': did you mean 'cartpole'?"),
        ([*CLOCK, "--split", "tny"], "unknown split 'tny': did you mean 'tiny'?"),
        ([*CLOCK, "--param", "size=1"], "unknown parameter of clock 'size'"),
        ([*CLOCK, "--horizon", "0"], "--horizon is '0', expected whole numbers of at least 1"),
        ([*CLOCK, "--timeout", "soon"], "--timeout is 'soon', expected a time such as"),
        ([*CLOCK, "--limit", "0"], "'--limit'"),
        ([*CLOCK, "--device", "cpu"], "none of the detectors has a device (clock)"),
        ([*CLOCK, "--device", "tpu"], "'--device'"),
        ([*CLOCK, "-k", "(iid"], "-k '(iid' cannot be read"),
        ([*CLOCK, "-p", "such"], "-p is 'such', expected no:NAME"),
        ([*CLOCK, "--config", "nowhere.toml"], "'nowhere.toml' cannot be read"),
        ([*CLOCK, "--output", "file/out"], "cannot be written to"),
        (["show", "nowhere", "--metric", "acc"], "unknown metric 'acc': did you mean 'auc'?"),
        (["data", "build", "mini", "--train", "3"], "is published: --train would make another"),
        (["data", "build", "dev"], "--train, --calibration, --test, --seed-base must be given"),
        (["policies", "train", "antt"], "unknown environment 'antt': did you mean 'ant'?"),
        (["policies", "evaluate", "ant", "--episodes", "0"], "'--episodes'"),
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


def test_show_prints_what_the_run_printed(run, clock):
    printed = (clock.parent / "printed").read_text()
    code, shown, _ = run("show", clock)
    assert code == 0
    tables = shown[: shown.index("Split tiny")]
    assert "Separability" in tables
    assert "4 calibration episodes; 38 needed at 5 %: guaranteed alarms at 5 % (clock)." in tables
    assert tables in printed
    assert printed.count(tables.splitlines()[0]) == 1  # the verdict
    assert "All metrics" not in shown
    wide = run("show", clock, "--wide")[1]
    assert "All metrics" in wide
    assert PAPER not in shown + wide
    assert PAPER in run("show", clock, "--paper")[1]
    assert "50.0 [50.0, 50.0]" in run("show", clock, "--intervals")[1]


def test_show_recomputes_metrics_from_scores(run, clock, tmp_path):
    shutil.copytree(clock, "oodd-results")
    file = tmp_path / "oodd-results" / "records.jsonl"
    before = file.read_text()
    assert '"value": 0.5' in before
    file.write_text(before.replace("0.5", "0.9"))
    assert "90.0" in run("show", "oodd-results", "--stored", "--markdown")[1]
    assert "90.0" not in run("show", "oodd-results", "--markdown")[1]


def test_two_rows_of_one_run_are_compared(run):
    run("run", "--detector", "clock,range", "--env", "all", "--split", "tiny")
    code, out, _ = run("compare", "oodd-results", "range", "clock")
    assert code == 0
    assert re.search(r"matched AUC: range \S+, clock 50.0 %, difference \S+ \[.*\], p = ", out)
    assert out.startswith(("range beats clock by ", "No difference is shown "))
    assert "16 cells\n" in out
    code, _, err = run("compare", "oodd-results", "range")
    assert code == 4
    assert "rows 'range', expected two" in err


def test_a_failed_detector_is_forgotten(run, failing, tmp_path):
    run("run", "--detector", "fails,clock", "--env", "cartpole", "--split", "tiny")
    place = tmp_path / "oodd-results"
    assert run("show", place)[0] == 1
    assert list((place / "logs").iterdir())
    code, out, _ = run("forget", place, "--failed")
    assert (code, out) == (0, f"8 cells removed from {place}\n")
    assert not list((place / "logs").iterdir())
    assert run("show", place)[0] == 0
    assert run("forget", place, "--failed")[0] == 5
    # Scores stay while another cell is of them.
    assert run("forget", place, "-k", "iid")[0] == 0
    assert list((place / "scores").iterdir())
    assert run("forget", place, "-k", "clock")[0] == 0
    assert not list((place / "scores").iterdir())
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


@pytest.mark.parametrize(
    ("missing", "arguments", "extra"),
    [
        ("gymnasium", BUILD, "gym"),
        ("pybullet", ["policies", "evaluate", "hopper"], "bullet"),
        ("torch", ["policies", "train", "hopper"], "train"),
    ],
)
def test_a_missing_extra_is_named_with_the_command(tmp_path, missing, arguments, extra):
    # Worker processes must not find it either.
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / f"{missing}.py").write_text("raise ImportError('none here')\n")
    done = subprocess.run(
        [sys.executable, "-m", "oodd_eval", *arguments], cwd=tmp_path, capture_output=True,
        text=True, check=False,
        env={**os.environ, "OODD_EVAL_DATA": str(tmp_path), "PYTHONPATH": str(tmp_path / "first")},
    )  # fmt: skip
    assert done.returncode == 4, done.stderr
    assert f"pip install 'oodd-eval[{extra}]'" in done.stderr


def test_help_is_short_and_says_what_to_do_first(capsys):
    assert cli.main([]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    first = re.search(r"^First steps:\n(.*?)\n\n", out, re.MULTILINE | re.DOTALL)[1]
    assert [line.split()[1] for line in first.splitlines()] == [
        "run", "show", "list", "leaderboard", "data",
    ]  # fmt: skip
    assert [int(n) for n in re.findall(r"^  (\d)  ", out, re.MULTILINE)] == [0, 1, 2, 3, 4, 5]
    assert cli.main(["--version"]) == 0
    assert re.fullmatch(r"oodd-eval \d+\.\d+\.\d+\S*\n", capsys.readouterr().out)


def commands(rows, *names):
    """The words of every command of a table."""
    for name, (_, target) in rows.items():
        yield from [[*names, name]] if isinstance(target, str) else commands(target, *names, name)


def test_help_of_a_group_needs_no_extra_of_its_commands(capsys, monkeypatch):
    def import_all_but_recording(target, load=cli_package.load):
        if target.startswith("oodd_recording"):
            raise MissingExtraError("recording needs the simulators")
        return load(target)

    monkeypatch.setattr(cli_package, "load", import_all_but_recording)
    assert cli.main(["leaderboard", "--help"]) == 0
    text = capsys.readouterr().out
    assert "  rerun " in text
    assert "oodd-eval leaderboard verify" in text.partition("\nExamples:\n")[2]


@pytest.mark.parametrize(
    "words", [w for rows in cli.COMMANDS.values() for w in commands(rows)], ids=" ".join
)
def test_every_command_has_help_with_examples_that_can_be_parsed(capsys, words):
    assert cli.main([*words, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"Usage: oodd-eval {' '.join(words)} ")
    examples = re.findall(r"^  (oodd-eval .*)$", text.partition("\nExamples:\n")[2], re.MULTILINE)
    assert examples
    for example in examples:
        assert parse(example).command == words[-1]


@pytest.mark.parametrize(
    ("words", "completions"),
    [
        (["sh"], {"show"}),
        (["data", "ver"], {"verify"}),
        (["list", "en"], {"envs"}),
        (["run", "--det"], {"--detector"}),
        (["run", "--detector", "mewma,clo"], {"mewma,clock"}),
        (["run", "--env", "wal"], {"walker2d"}),
        (["run", "--config", "nowhere.toml", "--anomaly", "gravity,wind-l"], {"gravity,wind-l2r"}),
        (["data", "info", "noisy"], {"noisy-1", "noisy-5"}),
        (["show", "oodd-results", "--metric", "found_within_20_at_5"], {"found_within_20_at_5pct"}),
        (["info", "hop"], {"hopper"}),
        (["nonsense", "x"], set()),
    ],
)
def test_names_are_completed(words, completions):
    environment = {"COMP_WORDS": shlex.join(["oodd-eval", *words]), "COMP_CWORD": str(len(words))}
    done = subprocess.run(
        [sys.executable, "-m", "oodd_eval"], capture_output=True, text=True, check=True,
        env=os.environ | environment | {"_OODD_EVAL_COMPLETE": "bash_complete"},
    )  # fmt: skip
    assert {line.partition(",")[2] for line in done.stdout.splitlines()} == completions
    assert done.stderr == ""


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_by_the_printed_script(shell):
    path = f"{Path(sys.executable).parent}:{os.defpath}"
    script = subprocess.run(
        ["oodd-eval", "completion", shell], capture_output=True, check=True, env={"PATH": path}
    ).stdout.decode()
    assert "_OODD_EVAL_COMPLETE" in script
    if shell == "bash":
        program = (
            f"{script}\nCOMP_WORDS=(oodd-eval lea); COMP_CWORD=1; _oodd_eval_completion oodd-eval\n"
            "echo ${COMPREPLY[@]}"
        )
        done = subprocess.run(["bash", "-c", program], env={"PATH": path}, stdout=-1, check=True)
        assert done.stdout == b"leaderboard\n"


def test_info_describes_detectors_environments_and_anomalies(run):
    code, out, _ = run("info", "rf")
    assert code == 0
    assert re.search(r"^detector +rf, oodd-eval ", out)
    assert re.search(r"trees = \d+  ", out)
    code, out, _ = run("info", "hopper")
    assert "15 sensors" in out
    assert "torso height above its start (m)" in out
    code, out, _ = run("info", "gravity")
    assert re.search(r"^group +dynamics$", out, re.MULTILINE)
    code, _, err = run("info", "gravty")
    assert code == 4
    assert "did you mean 'gravity'" in err
