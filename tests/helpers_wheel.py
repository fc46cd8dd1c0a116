"""The wheel that the packaging tests install, and pip."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]


def pip(*arguments, cwd=None):
    done = subprocess.run([*PIP, *arguments], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def build_wheel(target):
    """Build the wheel of this checkout in a directory, and return its file."""
    pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(target), str(ROOT))
    (built,) = target.glob("*.whl")
    return built
