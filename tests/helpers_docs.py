"""The commands of the documents: found, made quick where they take minutes, and run."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from helpers_own import forget_own

ROOT = Path(__file__).parents[1]

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")),
         *sorted((ROOT / "detectors").rglob("*.md")), ROOT / "recording" / "README.md",
         *sorted((ROOT / "examples").rglob("*.md"))]  # fmt: skip

TINY_SPLIT = "--train 3 --calibration 2 --test 2 --cap 80"


@dataclass(frozen=True)
class Rule:
    """What happens to commands that match, and why. Patterns are searched in the whole line."""

    pattern: str
    why: str
    instead: str = ""


NOT_RUN = [
    Rule(r"^python3\.11 -m venv", "the README's two commands: .ci/run and test_readme"),
    Rule(r"^pip install (?!-e )", "needs an index; what is installed then is what runs here"),
    Rule(
        r"^(uvx|pipx) ", "need an index; test_readme reads what they run, test_packaging the wheel"
    ),
    Rule(r"^\. \.venv/bin/activate$", "the environment is this one; test_walk makes another"),
    Rule(r"^git ", "changes a repository"),
    Rule(r"^podman |^python -m build --wheel$", "needs the image of a registry"),
    Rule(r"^pip wheel ", "needs a build; test_walk makes one"),
    Rule(
        r"^(export|pip download|python -m zipfile) |^pip install -e examples/oodd-go1",
        "gets a robot that others published",
    ),
    Rule(r"^OODD_WATCHDOG=\S+ inspect-robots ", "a program of others; test_inspect_robots runs it"),
    Rule(
        r"^rm -rf dist$|^python -m build$|\.ci/check-dist", "test_packaging builds and tries both"
    ),
    Rule(r"^python -m twine |^pip index ", "need distributions or an index; test_packaging checks"),
    Rule(r"^(mkdir|cp) ", "moves what a command of PARSED_ONLY would have made"),
    Rule(r"^(dask |dask-)", "servers that stay; test_executors starts them"),
    Rule(r"^python docs/figures/make\.py$", "test_figures_are_what_the_script_draws runs it"),
    Rule(r"^python docs/figures/environments\.py$", "test_page calls what it does"),
    Rule(r"^properdocs build", "the fixture of test_docs runs it"),
    Rule(r"\bskab\b", "needs files that others published; test_recipes has some of their shape"),
    Rule(r"^python benchmarks/(?:public_logs|promises)\.py", "the same, and minutes"),
]
"""Commands that no test of this module runs."""

PARSED_ONLY = [
    Rule(r"^oodd-eval leaderboard season\b", "minutes, or a night; test_season runs small ones"),
    Rule(r"^oodd-eval compare RESULTS\b", "needs results on files that others published"),
    Rule(r"^oodd-eval data build (standard|paper|reduced)\b", "hours of simulation"),
    Rule(r"^oodd-eval data (build ladder|calibrate)\b", "minutes of simulation; test_ladder"),
    Rule(r"--split ladder\b", "takes minutes to build; test_ladder runs over a small one"),
    Rule(r"^oodd-eval data fetch https?:", "needs a network; test_transfer serves one"),
    Rule(r"^oodd-eval reproduce .*--render-only", "renders what hours computed; "
         "test_reproduce_run renders what minutes did"),
    Rule(r"^oodd-eval data (inspect|import) (g1|bags|mug)\b",
         "needs a data set of LeRobot, or a bag; tests of the readers write both"),
    Rule(r"^oodd-eval data import cube\.toml$", "needs trials; test_inspect_robots records them"),
    Rule(r"^oodd-eval (data import rollouts\.toml|run --split rollouts)\b",
         "needs rollouts; test_rollouts makes some"),
    Rule(r"^oodd-eval data import plant --env pump ", "test_import imports such parts"),
    Rule(r"^oodd-eval .*\b(go1|walks)\b", "needs a robot that others published"),
    Rule(r"--executor dask://", "needs a cluster; test_executors starts one"),
]  # fmt: skip
"""Commands whose options are checked, and no more."""

QUICKER = [
    Rule(r"--split (standard|reduced|paper)\b", "takes hours to build", "--split mini"),
    Rule(r"(?<=--env )all\b", "one environment shows what seven do", "cartpole"),
    Rule(r" --param updates=\d+", "the next rule says how many"),
    Rule(r"--detector (\S*(riqn|npn|\bpe\b)\S*)", "trains for minutes",
         r"--detector \1 --param updates=2 --param members=1"),
    Rule(r"^(oodd-eval run .*(riqn|npn|\bpe\b|\brf\b|pyod:|sklearn:|river:|forecast:).*)$",
         "quick enough on a few", r"\1 --limit 2"),
    Rule(r"--horizon [\d,]*\d\d\b[\d,]*", "long rollouts take long", "--horizon 2"),
    Rule(r"--param trees=\d+", "small forests are forests", "--param trees=2"),
    Rule(r"--train \d+ --calibration \d+ --test \d+( --cap \d+)?", "a few episodes do",
         TINY_SPLIT),
    Rule(r"^(oodd-eval data build (?!.*--env).*)$", "one environment shows what seven do",
         r"\1 --env cartpole"),
    Rule(r"--episodes \d+", "one shows what twenty do", "--episodes 1"),
    Rule(r"^(oodd-eval policies train .*)--steps \d+", "trains for minutes", r"\1--steps 600"),
    Rule(r"^(oodd-eval reproduce (?!.*(--plan|--render-only)).*)$", "computes for hours",
         r"\1 --plan"),
]  # fmt: skip
"""What is changed in commands so that they take seconds; all rules that match, in this order."""


def commands(text):
    """Commands of a page in their order: lines of ``sh`` blocks, and of indented blocks."""
    found = []
    position = 0
    for match in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        found += _indented(text[position : match.start()])
        if match[1] in {"sh", "console"}:
            found += _lines(match[2])
        position = match.end()
    return found + _indented(text[position:])


def _indented(prose):
    return [
        line.strip() for line in re.findall(r"^ {4}(?:\$ )?(oodd-eval .*)$", prose, re.MULTILINE)
    ]


def _lines(block):
    lines = block.replace("\\\n", " ").splitlines()
    lines = [re.sub(r"^\$ ", "", line).strip() for line in lines]
    return [line for line in lines if line and not line.startswith("#")]


def python_blocks(text):
    return re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def python_with_output(text):
    """Python blocks of a page, each with the text block below it, which it prints, or None."""
    blocks = [*re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)]
    for block, below in zip(blocks, [*blocks[1:], None], strict=True):
        if block[1] == "python":
            printed = below and below[1] == "text" and not text[block.end() : below.start()].strip()
            yield block[2], below[2] if printed else None


def matching(rules, command):
    return next((rule for rule in rules if re.search(rule.pattern, command)), None)


def quick(command, rules=()):
    for rule in (*rules, *QUICKER):
        command = re.sub(rule.pattern, rule.instead, command)
    return command


def parse(command):
    """Check the options of an ``oodd-eval`` command without running it; return them."""
    from oodd_eval.cli import Command
    from oodd_eval.cli.main import main

    contexts = []
    with patch.object(Command, "invoke", lambda _, context: contexts.append(context) or 0):
        assert main(shlex.split(command, comments=True)[1:]) == 0
    # Help has no options.
    return (
        SimpleNamespace(command=contexts[0].info_name, **contexts[0].params) if contexts else None
    )


class Session:
    """A directory in which the commands of a page are carried out one after the other."""

    def __init__(self, directory, monkeypatch):
        self.directory, self._monkeypatch = directory, monkeypatch
        monkeypatch.chdir(directory)
        monkeypatch.setenv("OODD_EVAL_DATA", str(directory / "splits"))
        monkeypatch.setenv("COLUMNS", "120")

    def run(self, command):
        """Carry out one command; return its exit code and what it printed."""
        words = shlex.split(command, comments=True)
        if words[:3] == ["pip", "install", "-e"]:
            return self._install(re.sub(r"\[.*\]$", "", words[3]))
        if words[0] == "oodd-eval":
            return self._in_process(words[1:])
        return self._process(words)

    def _in_process(self, arguments):
        from oodd_eval.cli.main import main

        return main(arguments)

    def _process(self, words):
        """Run a program of this environment; words such as ``NAME=value`` come before it."""
        env = dict(os.environ)
        while re.match(r"[A-Z_]+=", words[0]):
            name, _, value = words.pop(0).partition("=")
            env[name] = value
        known = {"oodd-eval": "oodd_eval", "pytest": "pytest"}
        program = [sys.executable, "-m", known[words[0]]] if words[0] in known else words[:1]
        if words[0] == "python":
            program = [sys.executable]
            if words[1].endswith(".py"):
                # Scripts of the repository, which the documents call from its root.
                words[1] = str(ROOT / words[1])
        done = subprocess.run(
            [*program, *words[1:]], env=env, capture_output=True, text=True, check=False
        )
        sys.stdout.write(done.stdout + done.stderr)
        return done.returncode

    def _install(self, path):
        """Put a plug-in project on the path with the metadata that pip would write for it.

        That pip itself can do it is what test_walk and test_packaging show.
        """
        project = Path(path).resolve()
        told = tomllib.loads((project / "pyproject.toml").read_text())["project"]
        source = project / "src" if (project / "src").is_dir() else project
        info = source / f"{told['name'].replace('-', '_')}-{told['version']}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {told['name']}\nVersion: {told['version']}\n"
        )
        points = [
            f"[{group}]\n" + "".join(f"{name} = {module}\n" for name, module in entries.items())
            for group, entries in told["entry-points"].items()
        ]
        (info / "entry_points.txt").write_text("".join(points))
        self._monkeypatch.syspath_prepend(str(source))
        return 0

    def forget(self):
        """Forget what this page's plug-ins brought: another page has others."""
        forget_own()
        for name, module in list(sys.modules.items()):
            if str(getattr(module, "__file__", None)).startswith(f"{self.directory}{os.sep}"):
                del sys.modules[name]
