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
    python_with_output,
    quick,
)

pytestmark = pytest.mark.docs

FORECASTER = """
import numpy as np
from river import anomaly, preprocessing

def scaled_trees(n_trees=25, seed=None):
    return preprocessing.MinMaxScaler() | anomaly.HalfSpaceTrees(n_trees=n_trees, seed=seed)

class Forecaster:
    def __init__(self, order=1):
        self.order = order
    def fit(self, x, y):
        self.mean = y.mean(axis=0)
    def predict(self, x):
        return np.tile(self.mean, (len(x), 1))
"""

PERSISTENCE = "oodd-eval run --detector persistence --env cartpole"
QUICKEST = "--env acrobot,cartpole,lunarlander"

# What a page takes for granted: commands before it, files and folders, commands that fail, and
# patterns in its commands with what runs in their place, mostly as that fits in no time.
KNOWN = {
    "docs/adapters.md": {"files": {"my_models.py": FORECASTER}},
    "docs/leaderboard.md": {
        "before": [
            "oodd-eval run --detector persistence,random --env cartpole",
            "oodd-eval leaderboard submit oodd-results --detector persistence",
        ],
        "rules": {
            r"leaderboard show$": "leaderboard show --split mini",
            r"--detector mine": "--detector persistence",
            r"--split rebuilt/split": "--split mini",  # no season is recorded for a test
        },
    },
    "docs/how-to/release.md": {
        "before": [PERSISTENCE, "oodd-eval leaderboard submit oodd-results --detector persistence"]
    },
    "docs/metrics.md": {"before": ["oodd-eval run --detector rf --env cartpole --limit 2"]},
    "docs/regression-checks.md": {
        "rules": {
            r"--detector (rf|mine)\b": "--detector persistence",
            r"--oodd-detector mine": "--oodd-detector persistence",
        }
    },
    "docs/how-to/evaluate.md": {
        "files": {"hopper.toml": "```toml"},
        "rules": {
            r"(?<=--jobs 2) --timeout 10m": " --timeout 30m",
            r"--detector mewma,rf\b": "--detector mewma,random",
            r"(?<=mewma) rf\b": " random",
            r"rf and drift": "random and drift",
            r"--horizon 1,10 --seed 0,1": "--seed 0,1",
        },
    },
    "docs/how-to/own-data.md": {
        "files": {"make_logs.py": "```python"},
        "before": ["python -m make_logs"],
        # There are episodes enough for its networks.
        "rules": {
            r"--detector panel,mahalanobis,range,clock": "--detector panel --param forecast=linear"
        },
    },
    "docs/data.md": {
        "rules": {
            r"data build worlds$": "data build worlds --env tank",
            r"--split worlds --env all": "--split worlds --env tank",
        }
    },
    "docs/how-to/own-environment.md": {
        "rules": {
            r"^pytest oodd-two-link": "oodd-eval check two-link",
            # test_trial_environment calibrates.
            r"--suite ladder": "--strength weak-motor=0.5",
            r"mewma,persistence": "persistence",
        }
    },
    "docs/how-to/interventions.md": {
        "files": {"oodd_swing.py": "```python", "pyproject.toml": "```toml"}
    },
    "docs/how-to/policies.md": {
        "files": {"make_actor.py": "```python"},
        "folders": ["recording/policies"],
        "rules": {r"recording/(?=policies/)": ""},
    },
    "docs/how-to/monitors.md": {
        "files": {
            "make_runs.py": "```python",
            "pump.toml": "```toml",
            "make.py": """
                import json
                import struct
                from pathlib import Path

                import numpy as np

                def message(kind, content):
                    return struct.pack("<HB", len(content), ord(kind)) + content

                rng = np.random.default_rng(0)
                formats = (
                    b"estimator_innovation_test_ratios:uint64_t timestamp;float heading;",
                    b"estimator_innovations:uint64_t timestamp;float[2] gps_hvel;",
                )
                Path("flights").mkdir()
                for i in range(19):
                    text = b"ULog\\x01\\x12\\x35\\x01" + struct.pack("<Q", 5)
                    text += message("B", bytes(40)) + b"".join(message("F", f) for f in formats)
                    for number, content in enumerate(formats):
                        name = content.partition(b":")[0]
                        text += message("A", struct.pack("<BH", 0, number) + name)
                    for t, (a, b, c) in enumerate(rng.normal(size=(60, 3))):
                        stamp = 200_000 * (t + 1)
                        text += message("D", struct.pack("<HQf", 0, stamp, a * a))
                        text += message("D", struct.pack("<HQff", 1, stamp, b, c))
                    Path(f"flights/{i}.ulg").write_bytes(text)
                Path("rollouts").mkdir()
                for task in (0, 1):
                    episodes = []
                    for i in range(14):
                        errors = rng.gamma(2, size=60 if i > 11 else 40 + i) + (i > 11)
                        steps = [{"t": t, "chunk_mse": e, "grip": -e} for t, e in enumerate(errors)]
                        facts = {"task_id": task, "success": i < 12, "steps": steps}
                        episodes.append(json.dumps({"episode_id": i, **facts}))
                    text = "\\n".join(episodes)
                    Path(f"rollouts/task_{task}.jsonl").write_text(text)
            """,
        },
        "before": ["python -m make_runs", "python -m make"],
    },
    "docs/how-to/scan.md": {
        "files": {
            "arm.toml": """
                split = "arm"
                sensors = ["speed", "torque"]
                [nominal]
                files = ["*.csv"]
            """,
            "make.py": """
                from pathlib import Path

                import numpy as np

                from oodd_live import Watchdog

                rng = np.random.default_rng(0)
                for folder, shift in (("logs", 9), ("today", 0)):
                    Path(folder).mkdir()
                    for i in range(20):
                        rows = rng.normal(size=(60, 2)) + (shift if i == 5 else 0)
                        lines = ["speed,torque", *(f"{a},{b}" for a, b in rows)]
                        Path(folder, f"{i}.csv").write_text("\\n".join(lines))
                nominal = [rng.normal(size=(60, 2)) for _ in range(40)]
                names = ["speed", "torque"]
                watchdog = Watchdog.fit("mewma", nominal[:20], nominal[20:], 0.1, sensors=names)
                watchdog.save("arm.npz")
            """,
        },
        "before": ["python -m make"],
        "fails": [r"^oodd-eval scan logs"],
    },
    "examples/oodd-swimmer/README.md": {
        "folders": ["examples/oodd-swimmer"],
        # Two calibration episodes keep no promise of 5 %.
        "rules": {r"--seeds 2": "--seeds 2 --level 50"},
    },
    "examples/oodd-inspect-robots/README.md": {"folders": ["examples/oodd-inspect-robots"]},
    "detectors/columns/README.md": {
        "files": {
            "flights.toml": "```toml",
            "make.py": """
                from pathlib import Path

                import numpy as np

                rng = np.random.default_rng(0)
                Path("logs").mkdir()
                for i in range(50):
                    fault = (np.arange(60) > 30) * (i >= 45)
                    innovation = rng.normal(size=60) + 9 * fault
                    columns = rng.normal(size=60), innovation, 1 * (innovation > 4), fault
                    lines = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
                    text = "\\n".join(["height,vel_innov,tripped,fault", *lines])
                    Path("logs", f"{'wind' if i >= 45 else 'calm'}-{i}.csv").write_text(text)
            """,
        },
        "before": ["python -m make"],
    },
    # The other two train networks for a minute.
    "detectors/rivals/README.md": {"rules": {r"(?<=pca,knn,deedee),rnd,paano": ""}},
    "detectors/rivals/networks.md": {"rules": {r"(--detector \S+)": r"\1 --param updates=20"}},
    "docs/reproduce.md": {"rules": {r"--tier reduced": "--tier mini"}},
    "docs/submitting.md": {
        "before": ["oodd-eval new mine", "pip install -e ./oodd-mine"],
        "rules": {
            r"--env all": QUICKEST,
            r"--wheel \S+": f"--sha256 {'0' * 64}",
            r"leaderboard build": "leaderboard build leaderboard",
        },
    },
    "detectors/README.md": {
        "files": {"oodd_bounds.py": "```python", "pyproject.toml": "```toml"},
        # It says so itself: too small to pass every check.
        "fails": [r"^oodd-eval check bounds$"],
    },
}

WALKED = ROOT / "docs/tutorial.md"
"""test_walk carries out this page in an environment of its own."""

WITH_COMMANDS = [path for path in PAGES if path != WALKED and commands(path.read_text())]
WITH_PYTHON = [path for path in PAGES if python_blocks(path.read_text())]

FRAGMENTS = {
    "README.md": "test_live_wrappers runs it and reads what it prints",
    "docs/board-data.md": "test_the_documents_program_reads_the_table builds a board for it",
    "examples/oodd-go1/README.md": "needs episodes of a robot that others published",
    "examples/oodd-inspect-robots/README.md": "test_inspect_robots runs it, and reads its figures",
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
    known = KNOWN.get(name(path), {})
    for file, source in known.get("files", {}).items():
        (tmp_path / file).write_text(text_of(source, path))
    for folder in known.get("folders", ()):
        shutil.copytree(ROOT / folder, tmp_path / Path(folder).name)
    # A policy is selected by one episode: that shows what a hundred do.
    monkeypatch.setattr("oodd_recording.train.train.SELECTION_EPISODES", 1)
    session = Session(tmp_path, monkeypatch)
    request.addfinalizer(session.forget)
    for command in (*known.get("before", ()), *commands(path.read_text())):
        if matching(NOT_RUN, command):
            continue
        if matching(PARSED_ONLY, command):
            parse(command)
            continue
        line = quick(
            command,
            [Rule(pattern, "", instead) for pattern, instead in known.get("rules", {}).items()],
        )
        if "--sandbox" in line and not shutil.which("bwrap"):
            pytest.skip("needs bubblewrap")
        fails = any(re.search(pattern, command) for pattern in known.get("fails", ()))
        code = session.run(line)
        printed = capsys.readouterr()
        assert code == int(fails), f"{line}\nexit code {code}\n{printed.out}{printed.err}"


@pytest.mark.filterwarnings("ignore::oodd_eval.errors.PromiseWarning")  # of few recordings
@pytest.mark.parametrize("path", [p for p in WITH_PYTHON if name(p) not in FRAGMENTS], ids=name)
def test_python_of_a_page_runs_and_prints_what_is_shown(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "page"}
    for block, shown in python_with_output(path.read_text()):
        exec(compile(block, name(path), "exec"), namespace)  # noqa: S102  the documents' own
        printed = capsys.readouterr().out
        assert shown is None or printed == shown


def test_rules_have_reasons_and_are_needed():
    shown = [command for path in WITH_COMMANDS for command in commands(path.read_text())]
    assert all(rule.why for rule in (*NOT_RUN, *PARSED_ONLY, *QUICKER))
    assert all(path in map(name, PAGES) for path in (*KNOWN, *FRAGMENTS))
    # A page's command is run, or stands on a list; nothing falls between.
    left = [c for c in shown if not matching(NOT_RUN, c) and not matching(PARSED_ONLY, c)]
    programs = {re.sub(r"^([A-Z_]+=\S+ )+", "", command).split()[0] for command in left}
    assert programs <= {"oodd-eval", "pip", "pytest", "python"}
