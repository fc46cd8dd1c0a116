"""Pages of environments, of the benchmark, the worlds and plug-ins: text, pictures and numbers."""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers_docs import ROOT
from helpers_own import BASIN, forget_own
from helpers_plugins import install
from oodd_recording import pictures, svg
from oodd_recording.closed_loop import RecordedEpisode
from oodd_recording.environments import make

from oodd_eval.cli.main import main
from oodd_eval.data.condition import Rung
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, WORLDS
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import MissingExtraError

sys.path.insert(0, str(ROOT / "docs" / "figures"))
import environments as page


@pytest.fixture(autouse=True)
def forgotten():
    """No environment of one test is known in the next."""
    yield
    forget_own()


def test_drawn_links_lie_where_the_simulator_has_them():
    mujoco = pytest.importorskip("mujoco", reason="needs the extra worlds")
    from oodd_worlds.arm import HOME, WORLD, nominal_model
    from oodd_worlds.pictures import link_frames

    data = mujoco.MjData(nominal_model())
    for angles in (HOME, (0.3, -0.7, 1.9, -0.4, 0.8, -1.1)):
        data.qpos[:] = angles
        mujoco.mj_forward(nominal_model(), data)
        links = [data.body(f"link{i}") for i in range(1, 7)]
        frames = link_frames(WORLD, angles)[1:]
        for link, frame in zip(links, frames, strict=True):
            np.testing.assert_allclose(frame[:3, 3], link.xpos, atol=1e-9)
            np.testing.assert_allclose(frame[:3, :3].ravel(), link.xmat, atol=1e-9)


def test_an_overview_names_the_strength_that_levels_share_or_that_none_reaches(monkeypatch):
    def rung(strength, *, reached=True):
        return {"strength": strength, "reached": reached}

    ladders = [
        ({"kept90": rung(0.3)}, "0.3"),
        ({"kept95": rung(0.2), "kept75": rung(0.7)}, "0.2"),  # kept90 is that of kept95
        ({"kept99": rung(0.1), "kept95": rung(4.0, reached=False)}, "> 4"),
        ({"kept99": rung(4.0)}, "> 4"),  # the bound keeps 99 %, and nothing is stronger
    ]
    for rungs, text in ladders:
        monkeypatch.setattr(
            page, "ladder_of", lambda _, r=rungs: {"iid": {"bound": 4.0, "rungs": r}}
        )
        monkeypatch.setattr(
            page, "rungs_of", lambda *_, r=rungs: {n: Rung(**x) for n, x in r.items()}
        )
        assert page._strength("hopper", "iid", "kept90") == f"[{text}](environments/hopper.md#iid)"


@pytest.mark.parametrize(("environment", "picture"), [("cartpole", "png"), ("tank", "svg")])
def test_pages_are_built_with_a_section_and_a_plot_for_each_kind(environment, picture):
    files = dict(page.built([environment]))
    text = files.pop(f"{environment}.md").decode()
    kinds = page.page_of(environment).kinds
    assert {*files} == {f"{environment}.{picture}", *(f"{environment}/{k}.svg" for k in kinds)}
    assert {*re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)} == {*files}
    assert re.findall("^### (.+)$", text, re.MULTILINE) == kinds
    for kind in kinds:
        rung, strength = page.page_of(environment).pictured(kind)
        assert f">{kind} at {rung} ({strength:g})<" in files[f"{environment}/{kind}.svg"].decode()


def test_pages_have_no_pictures_without_a_simulator(monkeypatch):
    def missing(_):
        raise MissingExtraError("recording needs the simulators")

    monkeypatch.setattr(page.Page, "pictures", missing)
    ((name, text),) = page.built(["hopper"])
    assert name == "hopper.md"
    assert "![" not in text.decode()


def test_every_environment_and_kind_is_in_the_tables_of_the_overview():
    committed = (ROOT / "docs" / "environments.md").read_text("utf-8")
    text = page.with_tables(committed, {"hopper.png", "arm.svg"})
    assert "<!-- built" not in text
    assert re.findall(r"^\| \[(\w+)\]", text, re.MULTILINE) == [*ENVIRONMENTS, *WORLDS]
    assert {*ANOMALIES} <= {*re.findall(r"^\| `([\w-]+)`", text, re.MULTILINE)}
    assert re.findall(r'<img src="environments/([\w.]+)"', text) == ["hopper.png", "arm.svg"]


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_nominal_values_are_those_of_the_simulators(environment):
    simulator = make(environment)
    simulator.reset(1)
    told = page._WORDS["nominal"][environment]
    assert {name: simulator.get(name) for name in told} == pytest.approx(told)
    simulator.close()


def episodes(changed, rows=200, onset=60, sensors=None):
    """An episode of CartPole with some sensors changed from the onset on, and its twin of zeros."""
    twin = np.zeros((rows, 4), np.float32)
    broken = twin.copy()
    for sensor, value in changed.items():
        broken[onset:, sensor] = value
    nothing = RecordedEpisode(Trajectory(twin), np.zeros(rows - 1, np.float32), False, 1)
    parameters = {} if sensors is None else {"sensors": sensors}
    told = {"onset": onset, "effect": onset, "parameters": parameters}
    return replace(nothing, trajectory=Trajectory(broken), **told), nothing


def test_the_sensor_that_differs_most_in_its_spreads_is_shown():
    # Spreads are 0.2272, 0.1718, 0.01867 and 0.1913.
    changed = {0: 2.0, 2: 0.5}
    assert pictures.telling_sensor("cartpole", *episodes(changed)) == 2
    assert pictures.telling_sensor("cartpole", *episodes(changed, sensors=[0, 1])) == 0
    assert "pole angle (rad)" in pictures.plot("cartpole", "title", *episodes(changed))


def test_a_plot_shows_both_lines_around_the_onset():
    drawn = pictures.plot("cartpole", "a < b", *episodes({0: 1.0}))
    assert ">a &lt; b<" in drawn
    assert ">onset, step 60<" in drawn
    twin, broken = re.findall(r'points="([^"]+)"', drawn)
    twin, broken = ([tuple(map(float, p.split(","))) for p in x.split()] for x in (twin, broken))
    assert len(twin) == len(broken) == 121  # 30 rows before the onset, and 90 after
    assert twin[0] == (svg.LEFT, svg.BOTTOM)
    assert twin[:30] == broken[:30]
    assert {y for _, y in twin} == {svg.BOTTOM}
    assert {y for _, y in broken[30:]} == {svg.TOP}
    assert broken[-1] == (svg.RIGHT, svg.TOP)
    assert "<circle" not in drawn


# The command, for a plug-in

DESCRIBED = """

DESCRIPTION = "Water runs down.\\n\\n## Model\\n\\nTwo levels."
LADDER = Path(__file__).with_name("ladder.json")


def draw():
    return '<svg xmlns="http://www.w3.org/2000/svg"/>'


def measured(basin):
    pump = Quantity("pump", "l/s")
    sensors = (Quantity("upper", "m", noise=0.001), Quantity("lower", "m"),
               Quantity("outflow", "l/s", role="reference"))
    return replace(basin, sensors=sensors, title="Two Tanks", description=DESCRIPTION, picture=draw,
                   ladder=LADDER, task="loss", packages=("numpy",))
"""


@pytest.fixture
def basin(monkeypatch, tmp_path):
    def with_code(code):
        install(monkeypatch, tmp_path / "plugin", "basin", code, header="")
        return tmp_path / "plugin"

    monkeypatch.chdir(tmp_path)
    return with_code


def rows_of(text, heading):
    """Cells of the first table below a heading, without its header."""
    lines = text.partition(f"\n{heading}\n")[2].splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("|")) + 2
    table = []
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        table.append([cell.strip() for cell in line[1:-1].split("|")])
    return table


def test_a_plugin_gets_a_page_of_its_environment(basin, tmp_path, capsys):
    basin(BASIN)
    assert main(["data", "page", "basin"]) == 0
    assert "page of basin: pages/basin.md" in capsys.readouterr().out
    files = {
        p.relative_to(tmp_path / "pages").as_posix() for p in (tmp_path / "pages").rglob("*.*")
    }
    assert files == {"basin.md", "basin/seep.svg"}  # it draws no frame
    text = (tmp_path / "pages" / "basin.md").read_text("utf-8")
    assert "](basin/seep.svg)" in text
    assert text.count("![") == 1
    assert "\n| controller | code |\n" in text
    sensors = rows_of(text, "## Sensors")
    assert [row[:3] for row in sensors] == [
        ["0", "upper", "m"], ["1", "lower", "m"], ["2", "outflow", "l/s"]
    ]  # fmt: skip
    assert [row[-1] for row in sensors] == ["yes"] * 3
    assert rows_of(text, "## Actions") == [["0", "pump", ""]]
    assert "from -1 to 1" in text
    assert (
        "**Seep**, dynamics. Water leaves faster.\n\nStrength: share of the flow; at most 3."
        in text
    )
    assert "seep at a quarter of its bound (0.75)" in text
    assert "`friction`" in text  # which can be recorded as well


def test_a_page_has_description_ladder_roles_and_limits(basin, tmp_path):
    code = BASIN.replace("import gymnasium\n", "import gymnasium\nfrom dataclasses import replace\n"
                        "from pathlib import Path\n")  # fmt: skip
    code = code.replace("Box(-1.0, 1.0, (1,))", "Box(0.0, 2.5, (1,))")
    code = code.replace(
        "return super().step([2.0 * action - 1.0])", "return super().step([action])"
    )
    code = code.replace("-abs(float(self.level[1]) - 2.0)", "1 / (1 + abs(float(self.level[1])))")
    code = code.replace(
        '        EnvironmentSpec("basin"', '        measured(EnvironmentSpec("basin"'
    )
    code = code.replace("attributes=FRICTION),", "attributes=FRICTION)),")
    folder = basin(code.replace("@hookimpl", f"{DESCRIBED}\n\n@hookimpl", 1))
    rung = {
        "strength": 0.5,
        "low": 0.4,
        "high": 0.75,
        "kept": 0.9,
        "kept_low": 0.8,
        "kept_high": 1.01,
    }
    ladder = {"basin": {"seep": {"unit": "", "bound": 3.0, "rungs": {"loss10": rung}}}}
    (folder / "ladder.json").write_text(json.dumps(ladder))
    assert main(["data", "page", "basin", "--output", "here", "-q"]) == 0
    text = (tmp_path / "here" / "basin.md").read_text("utf-8")
    begin = (
        "# Two Tanks\n\n![Two Tanks: a drawing](basin.svg)\n\nWater runs down.\n\n|  | `basin` |"
    )
    assert text.startswith(begin)
    assert (
        text.index("| controller |")
        < text.index("\n## Model\n\nTwo levels.")
        < text.index("## Sensors")
    )
    assert f"| simulated by | numpy {np.__version__} |" in text
    assert (tmp_path / "here" / "basin.svg").read_text().startswith("<svg")
    upper, lower, outflow = rows_of(text, "## Sensors")
    assert upper[:5] == ["0", "upper", "m", "measured", "0.001"]
    assert lower[3:5] == ["measured", ""]
    assert (outflow[3], outflow[-1]) == ("reference", "")
    assert rows_of(text, "## Actions") == [["0", "pump", "", "0", "2.5"]]
    assert "from -1 to 1" not in text
    # It grows by what it does not keep: 1 - .9, from 1 - 1.01 to 1 - .8.
    assert rows_of(text, "### seep") == [
        ["`loss10`", "0.5 (0.4 to 0.75)", "10 % (-1 to 20)", "yes"]
    ]
    assert "seep at loss10 (0.5)" in (tmp_path / "here" / "basin" / "seep.svg").read_text()


def test_kinds_of_a_page_can_be_chosen(basin, tmp_path, capsys):
    basin(BASIN)
    assert main(["data", "page", "valve", "--anomaly", "iid,seep"]) == 0
    assert {p.stem for p in (tmp_path / "pages" / "valve").iterdir()} == {"iid", "seep"}
    text = (tmp_path / "pages" / "valve.md").read_text("utf-8")
    assert "One of them is chosen in each step" in text
    assert main(["data", "page", "valve", "--anomaly", "gravity"]) == 4
    assert "gravity" in capsys.readouterr().err
    assert main(["data", "page", "vale"]) == 4
    assert "valve" in capsys.readouterr().err


RENDERED = """
    metadata = {"render_modes": ["rgb_array"]}

    def render(self):
        pixels = np.zeros((6, 804, 3), np.uint8)
        pixels[:, :402] = (255, 0, 10)
        return pixels

    def reset("""


def test_an_environment_that_renders_gets_a_frame(basin, tmp_path):
    basin(BASIN.replace("\n    def reset(", RENDERED, 1))
    assert main(["data", "page", "basin", "-q"]) == 0
    image_files = pytest.importorskip("PIL.Image")
    with image_files.open(tmp_path / "pages" / "basin.png") as image:
        pixels = np.asarray(image)
    # Halved until it is at most 400 wide, twice: 804 to 201.
    assert pixels.shape == (1, 201, 3)
    assert pixels[0, 0].tolist() == [255, 0, 10]
    assert pixels[0, -1].tolist() == [0, 0, 0]
    text = (tmp_path / "pages" / "basin.md").read_text("utf-8")
    assert "![basin: a frame half-way through an episode](basin.png)" in text


def test_numbers_of_an_axis_have_digits_enough_to_tell_its_ends_apart():
    assert svg._number(1.02, 10.0) == "1"
    assert svg._number(12.26, 0.5) == "12.3"
    assert svg._number(-0.0, 1.0) == "0"
    assert svg._number(123.0, 300.0) == "120"
