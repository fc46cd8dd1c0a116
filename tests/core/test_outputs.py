"""Outputs never overwrite an input: of all commands in the table, under any name of the input."""

import io
import itertools
import re
import tarfile
from pathlib import Path

import click
import pytest
from oodd_logs.inspection.logs import refuse_logs

from oodd_eval.cli import Group, is_output
from oodd_eval.cli.main import PROGRAM, main
from oodd_eval.data.fetch import fetch
from oodd_eval.data.files import refuse_inputs, write_text
from oodd_eval.errors import MissingExtraError, UsageError

WRITTEN = {
    "run": {"output"}, "scan": {"keep", "drop", "json", "html", "rerun", "mcap"},
    "forget": {"directory"},
    "compare": {"junit", "markdown", "write_reference"}, "reproduce": {"output"},
    "intervene": {"output"}, "new": {"output"},
    "data inspect": {"recipe", "json"}, "data import": {"output", "json"},
    "data fetch": {"output"},
    "data export": {"output"}, "data build": {"output"}, "data calibrate": {"output", "work"},
    "data page": {"output"}, "policies train": {"output"}, "policies import": {"output"},
}  # fmt: skip
"""Parameters at whose paths commands write, of all but those of the leaderboard."""

TEXTS = {("data import", "name"), ("scan", "fine")}
"""Parameters that may stand for a path, and are compared with outputs by the command itself."""


def commands(group=PROGRAM, before=()):
    for name in group.list_commands(None):
        try:
            command = group.get_command(click.Context(group, info_name="oodd-eval"), name)
        except MissingExtraError:
            continue
        if isinstance(command, Group):
            yield from commands(command, (*before, name))
        else:
            yield " ".join((*before, name)), command


COMMANDS = dict(commands())


def is_path(parameter):
    return isinstance(parameter.type, click.Path) or parameter.type.name in ("FILE", "DIR")


def is_input(parameter):
    is_split = "splits" in getattr(parameter.type, "kinds", ())
    return is_split or (is_path(parameter) and not is_output(parameter))


PAIRS = [
    pytest.param(name, output, source, id=f"{name} {output.name} {source.name}")
    for name, command in COMMANDS.items()
    for output, source in itertools.product(command.params, command.params)
    if is_output(output) and is_input(source)
]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_that_writes_is_declared(name):
    """A new path needs a kind: OUTPUT_FILE or OUTPUT_DIRECTORY, and its name in WRITTEN here."""
    parameters = COMMANDS[name].params
    outputs = {p.name for p in parameters if is_output(p)}
    if not name.startswith("leaderboard"):
        assert outputs == WRITTEN.get(name, set())
    for p in parameters:
        text = f"{p.metavar or ''} {getattr(p, 'help', None) or ''}"
        if getattr(p, "is_flag", False) or (name, p.name) in TEXTS:
            continue
        if p.name == "output" or re.search(r"\bwrites? ", text):
            assert is_output(p), f"{name}: {p.name} writes, and is no output"
        if re.search(r"\b(FILE|DIR)\b|\b(file|directory|folder) (of|with|to)\b", text):
            assert is_path(p) or is_input(p), f"{name}: {p.name} is a path, and has another type"


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def invocation(name, values):
    """Return a command line with some values, and anything where more is required."""
    words, command = name.split(), COMMANDS[name]
    for p in command.params:
        value = values.get(p.name)
        if value is None and p.required:
            value = p.type.choices[0] if isinstance(p.type, click.Choice) else "other"
        if value is not None:
            words.append(str(value) if isinstance(p, click.Argument) else f"{p.opts[0]}={value}")
    return words


def spelled(path, spelling, other):
    """Return another name of a path; a directory has no hard links."""
    if spelling == "relative":
        return Path("logs") / ".." / path.relative_to(other.parent)
    if spelling == "symbolic link":
        other.symlink_to(path)
    elif spelling == "hard link" and path.is_file():
        other.hardlink_to(path)
    else:
        return path
    return other


def kept_input(folder):
    """Make a directory that can be any input, and return it with a file in it."""
    directory = folder / "logs"
    directory.mkdir()
    (directory / "manifest.json").write_text("{}")
    (directory / "r00.csv").write_text("# a log, and TOML")
    return directory, directory / "r00.csv"


@pytest.mark.parametrize("spelling", ["same", "relative", "symbolic link", "hard link"])
@pytest.mark.parametrize(("name", "output", "source"), PAIRS)
def test_an_output_that_is_an_input_is_refused(
    name, output, source, spelling, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    directory, file = kept_input(tmp_path)
    pairs = [(file, file)] if is_path(source) else []
    if source.name != "config":  # it is read with the command line
        pairs.append((directory, directory if output.type.name == "DIR" else file))
    for i, (read, path) in enumerate(pairs):
        written = spelled(path, spelling, tmp_path / f"other-{i}")
        before = contents(tmp_path)
        words = invocation(name, {source.name: read, output.name: written})
        assert main(words) == 4, words
        error = capsys.readouterr().err
        assert f"{output.opts[0]} '{written}' would overwrite" in error
        assert f"'{read}" in error  # or a file of it
        assert contents(tmp_path) == before


def test_what_is_no_input_may_be_written(tmp_path):
    directory, file = kept_input(tmp_path)
    results, recipe = tmp_path / "results", tmp_path / "results" / "run.toml"
    (results / "below").mkdir(parents=True)
    recipe.touch()
    refuse_inputs(directory / "scan.html", [directory, file])  # new, beside logs
    refuse_inputs(tmp_path / "scan.html", [directory, file])
    refuse_inputs(directory / "results", [directory])
    refuse_inputs(results, [recipe, results / "below"])  # earlier results, to go on from
    (results / "policy.npz").touch()
    with pytest.raises(UsageError, match=r"'.*policy.npz' in it"):
        refuse_inputs(results, [results / "policy.npz"])
    with pytest.raises(UsageError, match="in it"):
        refuse_inputs(directory, [file])


def test_files_behind_links_in_a_folder_are_inputs(tmp_path):
    directory, file = kept_input(tmp_path)
    elsewhere = tmp_path / "elsewhere.csv"
    file.rename(elsewhere)
    file.symlink_to(elsewhere)
    for output in (elsewhere, file):
        with pytest.raises(UsageError, match="would overwrite a file of the input"):
            refuse_inputs(output, [directory])


def test_two_outputs_are_two_files(tmp_path, capsys):
    log = tmp_path / "a.csv"
    log.write_text("t,a\n0,1\n")
    assert main(["scan", str(log), f"--json={log}.x", f"--html={log}.x"]) == 4
    assert "--html would replace the first" in capsys.readouterr().err


def test_a_new_file_is_no_log_of_the_next_time(tmp_path, capsys):
    directory, _ = kept_input(tmp_path)
    before = contents(tmp_path)
    for words in (["scan", "--json"], ["scan", "--mcap"], ["data", "inspect", "--recipe"]):
        assert main([*words[:-1], str(directory), f"{words[-1]}={directory}/new.csv"]) == 4
        assert "would be one of the logs" in capsys.readouterr().err
    assert contents(tmp_path) == before
    refuse_logs([directory / "scan.html", directory / "scan.mcap", None], directory, "")
    refuse_logs([tmp_path / "new.csv"], directory, "")


RECIPE = """
split = "arm"
environment = "arm"
intervals = "labels.txt"
[nominal]
files = ["days/**/*.h5"]
parts = [0.4, 0.3, 0.3]
"""


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    """A recipe whose files are behind a link to a folder, where splits are found."""
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path))
    (tmp_path / "arm").mkdir()
    (tmp_path / "logs" / "days").mkdir(parents=True)
    (tmp_path / "logs" / "days" / "monday").symlink_to(tmp_path / "arm")
    (tmp_path / "logs" / "days" / "r00.h5").write_bytes(b"a log")
    (tmp_path / "arm" / "arm.h5").write_bytes(b"another log")
    (tmp_path / "logs" / "labels.txt").write_text("file,start,stop,kind\n")
    path = tmp_path / "recipe.toml"
    path.write_text(RECIPE)
    return path


def test_files_that_a_recipe_names_are_inputs(recipe, tmp_path, capsys):
    before = contents(tmp_path)
    logs = tmp_path / "logs"
    for output in (tmp_path / "arm" / "arm.h5", logs / "labels.txt"):
        assert main(["scan", str(logs), "--recipe", str(recipe), "--html", str(output)]) == 4
        assert "would overwrite" in capsys.readouterr().err
    assert main(["data", "import", str(recipe), "--root", str(logs)]) == 4
    assert "arm.h5' would overwrite the input" in capsys.readouterr().err
    assert main(["data", "import", str(recipe), "--output", str(tmp_path)]) == 4
    assert f"--output '{tmp_path}' would overwrite the input" in capsys.readouterr().err
    assert contents(tmp_path) == before


def test_a_damaged_split_is_not_replaced_with_its_copy_in_it(tiny_split, tmp_path, monkeypatch):
    home = tmp_path / "split"
    home.mkdir()
    with tarfile.open(tmp_path / "copy.tar", "w") as archive:
        for path in tiny_split.iterdir():
            archive.add(path, path.name)
    for path in tiny_split.iterdir():
        (home / path.name).write_bytes(path.read_bytes())
    damaged = next(home.glob("*.h5"))
    damaged.write_bytes(b"damaged")
    copy = (tmp_path / "copy.tar").rename(home / "copy.tar")
    before = contents(tmp_path)
    for address in (str(copy), copy.as_uri()):
        with pytest.raises(UsageError, match="damaged copy"):
            fetch(address, output=home)
    assert contents(tmp_path) == before
    copy = copy.rename(tmp_path / "copy.tar")
    assert fetch(str(copy), output=home).split.path == home
    assert damaged.read_bytes() != b"damaged"


def test_an_interrupted_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "scan.json"
    path.write_text("earlier")

    def interrupted(self, content):
        with io.FileIO(self, "w") as file:
            file.write(content[:2])
        raise KeyboardInterrupt

    monkeypatch.setattr(type(path), "write_bytes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_text(path, "later")
    assert contents(tmp_path) == {"scan.json": b"earlier"}
