"""Entries of strangers: wheels with a plug-in, and what an entry says of them."""

import hashlib
from pathlib import Path

import helpers_wheel
from helpers_plugins import HEADER


def write_wheel(directory, distribution, files, *, plugin, module):
    """Write a wheel of some files by name, with one plug-in; return its path."""
    points = f"{distribution.replace('-', '_')}-1.0.dist-info/entry_points.txt"
    files = {**files, points: f"[oodd_eval]\n{plugin} = {module}\n"}
    return helpers_wheel.write_wheel(directory, distribution, "1.0", files)


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
