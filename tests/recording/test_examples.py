"""The examples run, and show what they say."""

import ast
import json
import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers_own import forget_own
from PIL import Image

pytestmark = pytest.mark.slow

pytest.importorskip("gymnasium", reason="needs the extra gym")
EXAMPLE = Path(__file__).parents[2] / "examples" / "live_alarm.py"


@pytest.fixture(scope="module")
def example():
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE), run_name="live_alarm"))


@pytest.fixture(scope="module")
def kept(tmp_path_factory, example):
    """File of the watchdog that the example fits by default."""
    file = tmp_path_factory.mktemp("kept") / "fit"
    example.prepare("panel", 0.1, file)
    return str(file)


def test_a_live_loop_raises_an_alarm_after_the_onset_only(example, kept, capsys):
    nominal, anomalous = example.main(["--fit", kept, "--monitor"])
    assert nominal.alarms == []
    assert 150 <= min(anomalous.alarms) < 170
    told = capsys.readouterr().out
    assert "steps after the onset; " in told
    assert anomalous.readings[-1].alarm
    # The kept watchdog gives the same readings again.
    assert example.main(["--fit", kept])[1].readings == anomalous.readings


def test_the_robot_is_drawn_and_filmed_with_its_scores_and_sensors(
    example, kept, tmp_path, monkeypatch
):
    pytest.importorskip("matplotlib", reason="needs the extra plots")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    plot, film = tmp_path / "alarm.png", tmp_path / "alarm.gif"
    short = ["--steps", "40", "--onset", "20"]
    _, seen = example.main(["--fit", kept, *short, "--plot", str(plot), "--gif", str(film)])
    assert len(seen.frames) == len(seen.readings)
    assert plot.read_bytes().startswith(b"\x89PNG")
    with Image.open(film) as frames:
        assert frames.n_frames > 5


def test_what_was_fitted_is_kept(example, tmp_path):
    one = example.prepare("mewma", 0.1, tmp_path / "fit")
    other = example.prepare("any", 0.5, tmp_path / "fit")
    assert (other.rule, other.sensors) == (one.rule, one.sensors)


@pytest.fixture
def swimmer(monkeypatch):
    """The specs of the swimmer, known in this process as long as the test runs."""
    pytest.importorskip("mujoco", reason="needs the extra mujoco")
    from oodd_eval.data import registry

    monkeypatch.syspath_prepend(str(EXAMPLE.parent / "oodd-swimmer"))
    import oodd_swimmer

    specs = [*oodd_swimmer.oodd_environments(), *oodd_swimmer.oodd_anomalies()]
    registry.register(specs)
    yield specs
    forget_own()


def test_the_swimmer_swims_and_passes_its_checks(swimmer):
    from oodd_recording.checks import custom_checks
    from oodd_recording.closed_loop import evaluate_policy
    from oodd_recording.policies import load_policy

    assert evaluate_policy("swimmer", load_policy("swimmer"), episodes=3).min() > 60
    for spec in swimmer:
        assert not [
            wrong for _, carry_out in custom_checks(spec, "swimmer") if (wrong := carry_out())
        ]


@pytest.mark.docs
def test_the_notebook_prints_what_is_stored_in_it(capsys):
    for library in ("matplotlib", "pandas", "torch"):
        pytest.importorskip(library)
    notebook = json.loads((EXAMPLE.parent / "notebook.ipynb").read_text(encoding="utf-8"))
    # One network of three, with two fifths of its updates, tells the same.
    quicker = '"updates": 500}', '"updates": 200, "members": 1}'
    assert any(quicker[0] in line for cell in notebook["cells"] for line in cell["source"])
    space = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        *body, last = ast.parse("".join(cell["source"]).replace(*quicker)).body
        shown = isinstance(last, ast.Expr)
        exec(compile(ast.Module([*body, *([] if shown else [last])], []), "cell", "exec"), space)  # noqa: S102
        value = eval(compile(ast.Expression(last.value), "cell", "eval"), space) if shown else None  # noqa: S307
        outputs = cell["outputs"]
        printed = [o for o in outputs if o["output_type"] == "stream"]
        # The ensemble is small, and other machines train it to other last digits: an alarm may come
        # some rows sooner or later.
        told, expected = capsys.readouterr().out, "".join(t for o in printed for t in o["text"])
        told, expected = (re.sub(r"\d+%", "", text) for text in (told, expected))
        assert re.sub(r"\d+", "", told) == re.sub(r"\d+", "", expected)
        rows = [[int(n) for n in re.findall(r"\d+", text)] for text in (told, expected)]
        assert rows[0] == pytest.approx(rows[1], abs=5)
        pictures = [o for o in outputs if "image/png" in o.get("data", {})]
        assert bool(pictures) == hasattr(value, "savefig")
        if html := [o["data"]["text/html"] for o in outputs if "text/html" in o.get("data", {})]:
            # Notes also tell of a changed checkout.
            shown_html = re.sub("<p>Made with uncommitted[^<]*</p>", "", value._repr_html_())
            assert shown_html.split() == "".join(html[0]).split()
