"""Every command that the documents show is carried out, page by page, in the order of the page."""

import re
import shutil
import textwrap
from pathlib import Path

import pytest
from helpers_docs import (
    NOT_RUN,
    PAGES,
    PARSED_ONLY,
    QUICKER,
    ROOT,
    Rule,
    Session,
    commands,
    matching,
    parse,
    python_blocks,
    quick,
)

pytestmark = pytest.mark.docs

FORECASTER = """
import numpy as np

class Forecaster:
    def __init__(self, order=1):
        self.order = order
    def fit(self, x, y):
        self.mean = y.mean(axis=0)
    def predict(self, x):
        return np.tile(self.mean, (len(x), 1))
"""

SOMETHING = Rule(r"--detector rf\b", "a page's own example, on a detector that fits in no time",
                 "--detector persistence")  # fmt: skip


QUICKEST = "--env acrobot,cartpole,lunarlander"


def page(path, *, before=(), rules=(), files=None, folders=(), fails=()):
    """What a page takes for granted, and which of its commands are meant to fail."""
    known = {"before": before, "rules": rules, "files": files or {}, "folders": folders}
    return path, known | {"fails": fails}


KNOWN = dict(
    [
        page("docs/adapters.md", files={"my_models.py": FORECASTER}),
        page(
            "docs/leaderboard.md",
            before=(
                "oodd-eval run --detector persistence,random --env cartpole",
                "oodd-eval leaderboard submit oodd-results --detector persistence",
            ),
            rules=(
                Rule(
                    r"leaderboard show$",
                    "one board shows what all do",
                    "leaderboard show --split mini",
                ),
            ),
        ),
        page(
            "docs/how-to/release.md",
            before=(
                "oodd-eval run --detector persistence --env cartpole",
                "oodd-eval leaderboard submit oodd-results",
            ),
        ),
        page("docs/metrics.md", before=("oodd-eval run --detector rf --env cartpole --limit 2",)),
        page(
            "docs/regression-checks.md",
            before=("oodd-eval run --detector persistence --env cartpole",),
            rules=(
                SOMETHING,
                Rule(r"--oodd-detector mine", "one that is there", "--oodd-detector persistence"),
            ),
        ),
        page(
            "docs/how-to/evaluate.md",
            files={"hopper.toml": "```toml"},
            rules=(
                Rule(r"(?<=--jobs 2) --timeout 10m", "a busy machine", " --timeout 30m"),
                Rule(r"--detector mewma,rf\b", "fits in no time", "--detector mewma,random"),
                Rule(r"(?<=mewma) rf\b", "instead of it", " random"),
                Rule(r"rf and drift", "instead of it", "random and drift"),
                Rule(r"--horizon 1,10 --seed 0,1", "two fits show what four do", "--seed 0,1"),
            ),
        ),
        page(
            "docs/how-to/own-data.md",
            files={"make_logs.py": "```python"},
            before=("python -m make_logs",),
        ),
        page(
            "docs/how-to/own-environment.md",
            files={"oodd_pendulum.py": "```python", "pyproject.toml": "```toml"},
        ),
        page(
            "docs/how-to/live.md",
            rules=(Rule(r"(\w+_\w+\.py)", "fits in no time", r"\1 --detector mewma"),),
        ),
        page("examples/oodd-swimmer/README.md", folders=("examples/oodd-swimmer",)),
        page(
            "detectors/pe/README.md",
            rules=(Rule(r"(?<=fresh --detector )pe,pe-a", "the first command fits them", "mewma"),),
        ),
        page("docs/reproduce.md", rules=(Rule(r"--tier reduced", "it is built", "--tier mini"),)),
        page(
            "docs/submitting.md",
            before=("oodd-eval new mine", "pip install -e ./oodd-mine"),
            rules=(
                Rule(r"mine-standard", "an entry is named after its split", "mine-mini"),
                Rule(r"--env (all|hopper,ant,cartpole)", "three have to agree", QUICKEST),
            ),
        ),
        page(
            "detectors/README.md",
            files={"oodd_bounds.py": "```python", "pyproject.toml": "```toml"},
            # It says so itself: too small to pass every check.
            fails=(r"^oodd-eval check bounds$",),
        ),
    ]
)

WALKED = ROOT / "docs/tutorial.md"
"""test_walk carries out this page in an environment of its own."""

WITH_COMMANDS = [path for path in PAGES if path != WALKED and commands(path.read_text())]
WITH_PYTHON = [path for path in PAGES if python_blocks(path.read_text())]

FRAGMENTS = {
    "README.md": "test_live_wrappers runs it and reads what it prints",
    "docs/board-data.md": "test_the_pages_program_reads_the_table builds a board for it",
    "docs/tutorial.md": "a piece of the test file that `new` writes, which test_new runs",
    "detectors/README.md": "the plug-in that the commands of the page run",
}


def name(path):
    return str(path.relative_to(ROOT))


def text_of(source, path):
    """Return the content of a file: given, or the page's own block of that language."""
    if not source.startswith("```"):
        return textwrap.dedent(source)
    language = source.removeprefix("```")
    return re.search(rf"^```{language}\n(.*?)^```$", path.read_text(), re.MULTILINE | re.DOTALL)[1]


@pytest.mark.parametrize("path", WITH_COMMANDS, ids=name)
def test_commands_of_a_page_do_what_it_says(path, tmp_path, monkeypatch, capsys, request):
    known = KNOWN.get(name(path), page("")[1])
    for file, source in known["files"].items():
        (tmp_path / file).write_text(text_of(source, path))
    for folder in known["folders"]:
        shutil.copytree(ROOT / folder, tmp_path / Path(folder).name)
    # A policy is selected by one episode: that shows what a hundred do.
    monkeypatch.setattr("oodd_recording.train.train.SELECTION_EPISODES", 1)
    session = Session(tmp_path, monkeypatch)
    request.addfinalizer(session.forget)
    for command in (*known["before"], *commands(path.read_text())):
        if matching(NOT_RUN, command):
            continue
        if matching(PARSED_ONLY, command):
            parse(command)
            continue
        made = quick(command, known["rules"])
        if "--sandbox" in made and not shutil.which("bwrap"):
            pytest.skip("needs bubblewrap")
        fails = any(re.search(pattern, command) for pattern in known["fails"])
        code = session.run(made)
        told = capsys.readouterr()
        assert code == int(fails), f"{made}\nexit code {code}\n{told.out}{told.err}"


@pytest.mark.parametrize("path", [p for p in WITH_PYTHON if name(p) not in FRAGMENTS], ids=name)
def test_python_of_a_page_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "page"}
    for block in python_blocks(path.read_text()):
        exec(compile(block, name(path), "exec"), namespace)  # noqa: S102  the documents' own


def test_rules_have_reasons_and_are_needed():
    shown = [command for path in WITH_COMMANDS for command in commands(path.read_text())]
    assert all(rule.why for rule in (*NOT_RUN, *PARSED_ONLY, *QUICKER))
    assert all(path in map(name, PAGES) for path in (*KNOWN, *FRAGMENTS))
    # A page's command is run, or stands on a list; nothing falls between.
    left = [c for c in shown if not matching(NOT_RUN, c) and not matching(PARSED_ONLY, c)]
    programs = {re.sub(r"^([A-Z_]+=\S+ )+", "", command).split()[0] for command in left}
    assert programs <= {"oodd-eval", "pip", "pytest", "python"}
