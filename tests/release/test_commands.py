"""Commands of every package: their help, their extras, and requests that they refuse."""

import os
import re
import subprocess
import sys

import pytest
from helpers_docs import parse

from oodd_eval import cli as cli_package
from oodd_eval.cli import main as cli
from oodd_eval.errors import MissingExtraError

BUILD = ["data", "build", "dev", "--train=1", "--calibration=1", "--test=1", "--seed-base=90"]


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
    assert cli.main(["policies", "--help"]) == 0
    assert "  train " in capsys.readouterr().out


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
    ("arguments", "message"),
    [
        ("data bild", "unknown command of data 'bild': did you mean 'build'?"),
        ("leaderboard submit x --detector", "--detector"),
        ("data build mini --train 3", "is published: --train would make another"),
        ("data build dev", "--train, --calibration, --test, --seed-base must be given"),
        ("policies train antt", "unknown environment 'antt': did you mean 'ant'?"),
        ("policies evaluate ant --episodes 0", "'--episodes'"),
        ("check clock --env hopper", "--env is for anomalies, and clock is a detector"),
        ("scan logs --watchdog x --jobs 2", "--jobs is for fits, and --watchdog judges without"),
        ("scan logs --recipe x.toml --format csv", "--format is said by the recipe"),
        ("reproduce --render-only --budget 2h", "--budget is for a run, and --render-only runs"),
    ],
)
def test_a_wrong_request_is_exit_code_4_with_one_message(capsys, arguments, message):
    assert cli.main(arguments.split()) == 4
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.count("\n") == 1
