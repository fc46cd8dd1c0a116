"""What needs no PyBullet runs under newer Pythons, with the same results."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers_wheel import PIP

pytestmark = pytest.mark.packaging

NEWER = ("3.14", "3.13", "3.12")
RUN = ["run", "--detector", "clock,comb,persistence,range,mahalanobis", "--env", "cartpole"]


def interpreter():
    """Return the newest other Python of this machine that starts, or None."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for version in NEWER:
        found = [shutil.which(f"python{version}"), *versions.glob(f"{version}*/bin/python")]
        for path in filter(None, found):
            shown = subprocess.run([path, "--version"], capture_output=True, check=False)
            if shown.returncode == 0:
                return path
    return None


def records(directory):
    lines = (directory / "records.jsonl").read_text().splitlines()
    found = [json.loads(line) for line in lines]
    return {(r["detector"], r["anomaly"]): (r["status"], r["metrics"]) for r in found}


@pytest.mark.skipif(interpreter() is None, reason="no newer Python on this machine")
def test_a_newer_python_gives_the_same_results(wheel, tmp_path):
    environment = tmp_path / "venv"
    subprocess.run([interpreter(), "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin" / "python"
    install = [*PIP, "--python", python, "install", wheel]
    done = subprocess.run(install, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"its libraries cannot be installed: {done.stderr[-200:]}")
    results = {}
    for name, program in (("newer", python), ("here", sys.executable)):
        output = tmp_path / name
        subprocess.run(
            [program, "-W", "error", "-m", "oodd_eval", *RUN, "--output", output],
            cwd=tmp_path, capture_output=True, check=True,
            env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        )  # fmt: skip
        results[name] = records(output)
    assert {status for status, _ in results["newer"].values()} == {"ok"}
    assert len(results["newer"]) == 5 * 8
    for cell, (_, metrics) in results["here"].items():
        newer = results["newer"][cell][1]
        for metric, found in metrics.items():
            expected = found["value"] if found["value"] is None else pytest.approx(found["value"])
            assert newer[metric]["value"] == expected, (cell, metric)
