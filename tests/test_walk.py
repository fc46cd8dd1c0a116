"""From `new` to an entry of the leaderboard, editing nothing: the commands that `new` prints."""

import json
import os
import shlex
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

pytestmark = pytest.mark.packaging

NAME = "walk-ar"


class Walker:
    """A fresh environment that sees what this one has installed, and a place to work in."""

    def __init__(self, root):
        self.root = root
        self.work = root / "work"
        self.work.mkdir()
        venv.create(root / "env", with_pip=False)
        self.python = root / "env" / "bin" / "python"
        (site,) = (root / "env").glob("lib/*/site-packages")
        seen = [p for p in sys.path if Path(p).is_dir() and p != sysconfig.get_path("stdlib")]
        (site / "seen.pth").write_text("\n".join(seen))

    def run(self, *command):
        env = {"PATH": f"{self.python.parent}:{os.defpath}", "HOME": str(self.root),
               "OMP_NUM_THREADS": "1", "COLUMNS": "120"}  # fmt: skip
        done = subprocess.run(
            command, cwd=self.work, env=env, capture_output=True, text=True, check=False
        )
        told = done.stdout + done.stderr
        assert done.returncode == 0, f"{shlex.join(map(str, command))}\n{told}"
        return told

    def oodd(self, line):
        return self.run(self.python, "-m", "oodd_eval", *shlex.split(line))


@pytest.mark.slow
def test_ten_minute_walk(tmp_path):
    walker = Walker(tmp_path)
    printed = walker.oodd(f"new {NAME}").partition("next:\n")[2]
    install, check, run, submit = (line.strip() for line in printed.splitlines())

    # Everything that the project needs is here: no index is asked, and no build environment made.
    assert install == f'pip install -e "./oodd-{NAME}[test]"'
    walker.run(
        sys.executable, "-m", "pip", "--python", walker.python, "--disable-pip-version-check",
        "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation",
        f"./oodd-{NAME}",
    )  # fmt: skip

    listed = walker.oodd("list detectors").splitlines()
    assert [line.split()[:3] for line in listed if line.startswith(NAME)] == [
        [NAME, f"oodd-{NAME}", "0.1.0"]
    ]
    assert "failed" not in walker.oodd(check.removeprefix("oodd-eval "))
    assert "8 ok" in walker.oodd(run.removeprefix("oodd-eval ").replace("all", "cartpole"))

    walker.oodd(submit.removeprefix("oodd-eval "))
    (entry,) = (walker.work / "leaderboard" / "results").iterdir()
    assert json.loads((entry / "entry.json").read_text())["detectors"] == [NAME]
    walker.oodd(f"leaderboard verify {entry}")


def test_the_projects_own_tests_pass(tmp_path):
    walker = Walker(tmp_path)
    walker.oodd(f"new {NAME} -q --output project")
    walker.work /= "project"
    (walker.work / "conftest.py").write_text("import sys\nsys.path.insert(0, 'src')\n")
    told = walker.run(walker.python, "-m", "pytest", "-q", "-p", "no:cacheprovider")
    assert " passed" in told
    assert "failed" not in told
