"""Entries of strangers: wheels, which are zip files, and what an entry says of them."""

import hashlib
import zipfile
from pathlib import Path

from helpers_plugins import HEADER

WHEEL = "Wheel-Version: 1.0\nGenerator: a test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"


def write_wheel(directory, distribution, files, *, plugin, module, version="1.0"):
    """Write a wheel of some files by name, with one plug-in; return its path."""
    stem = f"{distribution.replace('-', '_')}-{version}"
    info = f"{stem}.dist-info"
    files = {
        **files,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n",
        f"{info}/WHEEL": WHEEL,
        f"{info}/entry_points.txt": f"[oodd_eval]\n{plugin} = {module}\n",
    }
    record = "".join(f"{name},,\n" for name in (*files, f"{info}/RECORD"))
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{stem}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        for name, content in {**files, f"{info}/RECORD": record}.items():
            wheel.writestr(name, content)
    return path


def write_entry(entries, name, wheel, *lines, sha256=None):
    """Write the entry of a wheel, which lies beside it; return its directory."""
    directory = entries / name
    directory.mkdir(parents=True)
    (directory / wheel.name).write_bytes(wheel.read_bytes())
    digest = sha256 or hashlib.sha256(wheel.read_bytes()).hexdigest()
    text = f'wheel = "{wheel.name}"\nsha256 = "{digest}"\nauthors = "A stranger"\n'
    (directory / "entry.toml").write_text(text + "".join(f"{line}\n" for line in lines))
    return directory


def write_plugin_entry(entries, name, code, *lines, **settings):
    """Write the entry of a plug-in of one module, as `helpers_plugins` writes them."""
    module = f"oodd_{name}"
    files = {f"{module}.py": HEADER + code}
    wheels = Path(entries).with_name(f"{Path(entries).name}-wheels")
    wheel = write_wheel(wheels, f"oodd-{name}", files, plugin=name, module=module)
    return write_entry(entries, name, wheel, *lines, **settings)
