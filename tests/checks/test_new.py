"""What `oodd-eval new` writes, and which names it refuses."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from helpers_docs import parse
from helpers_plugins import install
from oodd_checks import template
from oodd_checks.template import LONGEST, Project, write_project

from oodd_eval.cli.main import main
from oodd_eval.errors import OutputError, UsageError

LONG = ("abcde-" * 9)[: LONGEST - 1] + "z"


@pytest.mark.parametrize(
    ("name", "close"),
    [
        ("SlowDrift", "slow-drift"),
        ("9lives", "lives"),
        ("oodd-slow", "slow"),
        ("slow--drift", "slow-drift"),
        ("a" * (LONGEST + 1), "a" * LONGEST),
    ],
)
def test_a_name_that_is_none_gets_one_that_would_be(name, close):
    with pytest.raises(UsageError, match=f"is no name for a project: .*did you mean '{close}'"):
        Project(name)


@pytest.mark.parametrize(
    ("name", "taken"),
    [
        ("rf", "there is a detector 'rf' already, of oodd-eval"),
        ("adapters", "there is a plug-in 'adapters' already"),
        ("torch", "there is a module 'oodd_torch' already"),
        ("theirs", "of oodd-other 1.0"),
    ],
)
def test_a_name_that_is_taken_is_refused(name, taken, tmp_path, capsys, monkeypatch):
    code = "@hookimpl\ndef oodd_detectors(): return offer(theirs=Good)"
    install(monkeypatch, tmp_path / "site", "other", code)
    assert main(["new", name, "--output", str(tmp_path / "new")]) == 4
    message = capsys.readouterr().err
    assert taken in message
    assert f"such as 'my-{name}'" in message
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["hopper", "tank", "payload"])
def test_the_name_of_an_environment_is_taken_from_another(name, tmp_path, capsys):
    output = ["--output", str(tmp_path / "new")]
    assert main(["new", name, "--environment", *output]) == 4
    assert f"there is an environment or kind of anomaly {name!r} already" in capsys.readouterr().err
    assert main(["new", name, *output]) == 0


def test_a_directory_in_use_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(OutputError, match="exists and is not an empty directory"):
        write_project(Project("slow"), tmp_path)
    with pytest.raises(OutputError, match="exists and is not an empty directory"):
        write_project(Project("slow"), tmp_path / "mine.txt")
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


KINDS = pytest.mark.parametrize("environment", [False, True], ids=["detector", "environment"])


@KINDS
def test_nothing_is_left_to_fill_in(environment):
    for path, text in Project("slow-drift", environment).render().items():
        assert not re.search("@[A-Z]+@|TODO|FIXME|<<|>>|{{", path + text), path
        assert not text or text.endswith("\n"), path


@KINDS
@pytest.mark.parametrize("name", ["z", LONG], ids=["short", "long"])
def test_the_project_passes_its_own_linter(name, environment, tmp_path):
    write_project(Project(name, environment), tmp_path)
    ruff = shutil.which("ruff", path=str(Path(sys.executable).parent)) or "ruff"
    for command in (["check"], ["format", "--check"]):
        done = subprocess.run(
            [ruff, *command, "--no-cache", "."],
            cwd=tmp_path, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr


@KINDS
def test_commands_in_the_projects_readme_exist(environment):
    text = Project("slow", environment).render()["README.md"]
    commands = re.findall(r"(?:^|`)oodd-eval ([^\n`]+)", text, re.MULTILINE)
    assert len(commands) >= 4
    for line in commands:
        parse(f"oodd-eval {line}")


def workflow(environment=False):
    """Steps of the project's workflow that run something, and the lines that each runs."""
    text = Project("slow", environment).render()[".github/workflows/ci.yml"]
    (job,) = yaml.safe_load(text)["jobs"].values()
    return [(step, step["run"].splitlines()) for step in job["steps"] if "run" in step]


ADDRESS = "https://example.org/oodd-eval"


@pytest.fixture(params=["", ADDRESS], ids=["no address", "address"])
def address(request, monkeypatch):
    """The project with and without an address on the web."""
    monkeypatch.setattr(template, "repository", lambda: request.param)
    return request.param


def test_the_workflow_runs_what_the_readme_says(address):
    runs = {line for _, lines in workflow() for line in lines}
    block = re.search(r"```sh\n(.*?)```", Project("slow").render()["README.md"], re.DOTALL)[1]
    install, *rest = block.splitlines()
    assert {install, 'pip install -e ".[test]"', "pytest"} <= runs
    assert rest[0] == 'pip install -e ".[test]"'
    assert install.split(maxsplit=2)[2] == (
        f'"oodd-eval @ git+{ADDRESS}"' if address else "wheels/oodd_eval-*.whl"
    )


def test_the_project_links_to_an_address_only_where_there_is_one(address):
    text = "".join("".join(Project("slow", kind).render().values()) for kind in (False, True))
    links = set(re.findall(r"https?://[^\s)\"]+", text))
    assert links == ({address} if address else set())
    assert ("package index" in text) is not bool(address)


def test_next_commands_are_printed(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "slow"]) == 0
    printed = capsys.readouterr().out
    assert "  src/oodd_slow/detector.py\n" in printed
    install, *commands = printed.partition("next:\n")[2].splitlines()
    assert install == '  pip install -e "./oodd-slow[test]"'
    wheel, submit = map(str.strip, commands[-2:])
    assert wheel == 'pip wheel --no-deps --wheel-dir dist "./oodd-slow"'
    assert all(parse(command.strip()) for command in (*commands[:-2], submit))
    assert (tmp_path / "oodd-slow" / "pyproject.toml").is_file()


# The regression check of the workflow

NEWCOMER = """
import numpy as np
class SlowDetector:
  def __init__(self,*,seed=0,horizon=1,clip=10.0): self.mean=None
  def fit(self,nominal):
    rows=np.concatenate([t.observations for t in nominal]).astype(float)
    self.mean=rows.mean(0); self.std=np.maximum(rows.std(0),1e-6)
  def score(self,trajectory):
    if self.mean is None: raise RuntimeError("fit first")
    if trajectory.observation_dim!=len(self.mean):
      raise ValueError(f"{len(self.mean)} sensors expected, not {trajectory.observation_dim}")
    return (((trajectory.observations-self.mean)/self.std)**2).sum(1)
"""


def installed(monkeypatch, directory):
    """Install a newcomer's project as pip would, for other processes, and work in it."""
    write_project(Project("slow"), directory)
    (directory / "src/oodd_slow/detector.py").write_text(NEWCOMER)
    metadata = directory / "src" / "oodd_slow-0.1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: oodd-slow\nVersion: 0.1.0\n")
    (metadata / "entry_points.txt").write_text("[oodd_eval]\nslow = oodd_slow\n")
    commands = directory / ".venv"
    commands.mkdir()
    for name, module in (("pytest", "pytest"), ("oodd-eval", "oodd_eval")):
        (commands / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {module} "$@"\n')
        (commands / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{commands}:{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(directory / "src"))
    monkeypatch.chdir(directory)


def carried_out(*, last=False):
    """Carry out the steps but the installation, or the last; return exit code and output."""
    for step, lines in workflow()[-1 if last else 0 :]:
        if not any(line.startswith("pip install") for line in lines):
            done = subprocess.run(
                ["bash", "-eo", "pipefail", "-c", step["run"]],
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            if done.returncode:
                break
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow
def test_the_workflow_is_green_on_a_newcomers_code_and_red_when_a_figure_moved(
    tmp_path, monkeypatch
):
    installed(monkeypatch, tmp_path / "slow")
    code, output = carried_out()
    assert code == 0, output
    first = re.search(r"no reference yet: (oodd-eval .*)", output)[1]
    subprocess.run(first.split(), check=True)
    assert carried_out(last=True)[0] == 0

    reference = Path("reference.jsonl")
    lines = reference.read_text().splitlines(keepends=True)
    for number, (metric, change) in enumerate([("auc", -0.04), ("auc_matched", 0.04)]):
        record = json.loads(lines[number])
        assert set(record["metrics"]) == {"auc", "auc_matched"}  # each is compared
        record["metrics"][metric]["value"] += change
        moved = [*lines[:number], json.dumps(record) + "\n", *lines[number + 1 :]]
        reference.write_text("".join(moved))
        code, output = carried_out(last=True)
        assert code == 1, output
        assert "1 failed" in output
