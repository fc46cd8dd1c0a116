"""The tutorial's commands, in a fresh environment that has only what the page installs.

pip needs an index here, as it does for whoever follows the page.
"""

import os
import re
import shutil
import subprocess
import sys
import time

import pytest
import yaml
from helpers_docs import ROOT, commands
from oodd_leaderboard.entry import read_entries

pytestmark = pytest.mark.packaging

NAME = "slow-drift"
MINUTES = 10  # of wall time on two cores, by the page's title


class Walker:
    """A directory with the wheel in it, and a shell that stays in one environment."""

    def __init__(self, work, wheel):
        self.work = work
        shutil.copy(wheel, work)
        # With the versions that this project is tested with.
        self.env = {
            "HOME": str(work), "COLUMNS": "100", "PIP_CONSTRAINT": str(ROOT / "constraints.txt"),
            "PATH": f"{work / '.venv' / 'bin'}:{os.defpath}",
            **{name: value for name, value in os.environ.items() if name.startswith("PIP_")
               or name in ("SSL_CERT_FILE", "https_proxy", "http_proxy", "no_proxy")},
        }  # fmt: skip

    def run(self, command, where="."):
        command = re.sub(r"^python3\.11 ", f"{sys.executable} ", command)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", command], cwd=self.work / where, env=self.env,
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        told = done.stdout + done.stderr
        assert done.returncode == 0, f"{command}\n{told}"
        return told


@pytest.mark.slow
def test_the_tutorial_leads_from_nothing_to_a_place_on_the_board(tmp_path, wheel):
    walker = Walker(tmp_path, wheel)
    page = commands((ROOT / "docs" / "tutorial.md").read_text())
    start = time.monotonic()
    told = {command: walker.run(command) for command in page}
    assert time.monotonic() - start < 60 * MINUTES

    # What `new` prints as the next commands is what the page goes through.
    printed = told[f"oodd-eval new {NAME}"].partition("next:\n")[2].splitlines()
    assert len(printed) == 6
    for line in map(str.strip, printed):
        assert any(shown.startswith(line) for shown in page), line
    listed = told["oodd-eval list detectors"]
    assert re.search(rf"^{NAME} +oodd-{NAME} 0\.1\.0", listed, re.MULTILINE)
    assert "editable" not in walker.run("pip list").lower().partition("oodd-eval")[2].split()[0]
    (entry,) = read_entries(tmp_path / "leaderboard" / "entries")
    assert (entry.detector, entry.wheel) == (
        NAME,
        f"oodd_{NAME.replace('-', '_')}-0.1.0-py3-none-any.whl",
    )
    said = told["oodd-eval leaderboard place oodd-results --detector slow-drift"]
    assert re.search(rf"^{NAME} stands at place \d+ of \d+ by mean", said, re.MULTILINE)

    # The project's CI: first as it is, and then with the wheel that it waits for.
    project = f"oodd-{NAME}"
    workflow = yaml.safe_load((tmp_path / project / ".github/workflows/ci.yml").read_text())
    steps = [step for step in workflow["jobs"]["test"]["steps"] if "run" in step]
    assert ["if" in step for step in steps] == [False, False, True, True, True]
    for step in steps[:2]:
        walker.run(step["run"], project)
    (tmp_path / project / "wheels").mkdir()
    shutil.copy(wheel, tmp_path / project / "wheels")
    told = [walker.run(step["run"], project) for step in steps[2:]]
    assert " passed" in told[1]
    assert "no reference yet: oodd-eval compare" in told[2]
