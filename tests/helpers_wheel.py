"""The wheel that the packaging tests install, and pip."""

import subprocess
import sys
import zipfile
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


def write_wheel(directory, name, version, files, requires=()):
    """Write a wheel of some texts by their paths, as nobody's tool would; return its file."""
    stem = f"{name.replace('-', '_')}-{version}"
    required = "".join(f"Requires-Dist: {requirement}\n" for requirement in requires)
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{required}"
    tags = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    members = {f"{stem}.dist-info/METADATA": metadata, f"{stem}.dist-info/WHEEL": tags, **files}
    members[f"{stem}.dist-info/RECORD"] = "".join(f"{member},,\n" for member in members)
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{stem}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        for member, content in members.items():
            wheel.writestr(member, content)
    return path
