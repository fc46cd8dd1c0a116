"""The pages "Environments and anomalies": their text, pictures, words and numbers."""

import re
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
from helpers_docs import ROOT
from oodd_recording import page, pictures
from oodd_recording.environments import make
from oodd_recording.record import Episode

from oodd_eval.cli.main import main
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1
from oodd_eval.data.ladder import read_ladder
from oodd_eval.data.trajectory import Trajectory

DOCS = ROOT / "docs"
PAGES = DOCS / page.NAME
STALE = f"is not what `{page.COMMAND}` writes: run it in the root of the repository"


def test_committed_texts_are_those_of_the_present_numbers():
    texts = {f"{page.NAME}/{e}.md": page.environment_page(e) for e in ENVIRONMENTS}
    for name, text in {f"{page.NAME}.md": page.overview(), **texts}.items():
        assert (DOCS / name).read_text("utf-8") == text, f"docs/{name} {STALE}"


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_committed_pictures_are_those_of_the_present_strengths(environment):
    kinds = page.calibrated(environment)
    found = {path.stem: path.read_text() for path in (PAGES / environment).iterdir()}
    assert set(found) == set(kinds), f"docs/{page.NAME}/{environment} {STALE}"
    for kind in kinds:
        rung, strength = page.pictured(environment, kind)
        told = f">{kind} at {rung} ({strength:g})<"
        assert told in found[kind], f"docs/{page.NAME}/{environment}/{kind}.svg {STALE}"


def test_pages_and_pictures_are_small():
    sizes = [path.stat().st_size for path in PAGES.rglob("*") if path.is_file()]
    assert sum(sizes) < 2_500_000
    assert max(sizes) < 100_000


def test_the_same_bytes_are_drawn_again():
    rungs = {kind: page.pictured("cartpole", kind) for kind in ("iid", "wind-l2r")}
    first, second = (dict(pictures.draw_pictures("cartpole", rungs)) for _ in range(2))
    assert first == second
    assert list(first) == ["cartpole.png", "cartpole/iid.svg", "cartpole/wind-l2r.svg"]


def test_command_writes_overview_page_and_pictures(tmp_path, capsys):
    assert main(["data", "page", str(tmp_path), "--env", "cartpole"]) == 0
    told = capsys.readouterr().out
    assert str(tmp_path) in told.replace("\n", "")
    written = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    plots = {f"environments/cartpole/{kind}.svg" for kind in ANOMALIES}
    pages = {"environments.md", "environments/cartpole.md", "environments/cartpole.png"}
    assert written == pages | plots


def test_what_is_not_calibrated_says_so(monkeypatch):
    known = {"cartpole": {"iid": read_ladder()["cartpole"]["iid"]}}
    monkeypatch.setattr(page, "read_ladder", lambda: known)
    text = page.environment_page("cartpole")
    assert text.count("Not calibrated.") == len(ANOMALIES) - 1
    assert re.findall(r"\]\((cartpole/.*\.svg)\)", text) == ["cartpole/iid.svg"]
    assert page.environment_page("acrobot").count("Not calibrated.") == len(ANOMALIES)
    assert page.overview().count("not calibrated") == len(ANOMALIES) * len(ENVIRONMENTS) - 1


def test_a_level_that_is_not_reached_is_above_the_bound_and_plotted_at_it():
    assert not read_ladder()["cartpole"]["gravity"]["rungs"]["kept99"]["reached"]
    assert page.pictured("cartpole", "gravity") == ("kept99", 3.0)
    assert "[> 3](environments/cartpole.md#gravity)" in page.overview()
    section = page.environment_page("cartpole").partition("### gravity\n")[2].partition("###")[0]
    assert "| `kept99` | 3 | 100 % (100 to 100) | no: this is the largest |" in section


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_nominal_values_are_those_of_the_simulators(environment):
    simulator = make(environment)
    simulator.reset(1)
    told = page._WORDS["nominal"][environment]
    assert {name: simulator.get(name) for name in told} == pytest.approx(told)
    simulator.close()


def test_every_environment_and_kind_has_words_and_no_other():
    assert set(page._WORDS["environment"]) == set(ENVIRONMENTS)
    bases = {kind for kind in ANOMALIES if not kind.endswith("-intermittent")}
    assert set(page._WORDS["kind"]) == bases
    known = {*ENVIRONMENTS, "all", "discrete", "continuous"}
    assert all(set(words) <= known for words in page._WORDS["kind"].values())
    assert all(page._meaning(e, kind).endswith(".") for e in ENVIRONMENTS for kind in ANOMALIES)


@pytest.mark.parametrize(
    ("environment", "kind", "expected"),
    [
        ("acrobot", "calibration", "a factor of 10 (strength 9)"),
        ("lunarlander", "gravity", "gravity 9 to 10, nominally 10 (strength -0.1 to 0)"),
        ("ant", "components", "motor power 1.5, nominally 2.5 (strength 0.4)"),
        ("cartpole", "wind-l2r", "a gust in a step with probability 0.66 (strength 0.66)"),
        ("hopper", "wind-r2l", "0.33 taken from every command (strength 0.33)"),
    ],
)
def test_values_of_table_1_are_told_in_units_of_strength(environment, kind, expected):
    assert page.table1_value(environment, kind) == expected
    assert kind in TABLE1
    assert f"Table 1 of the paper: {expected}." in page.environment_page(environment)


def test_values_of_table_1_that_differ_by_sensor_are_told_as_a_range():
    told = page.table1_value("cartpole", "drift")  # spreads from 0.01867 to 0.2272
    assert told == "a slope of 0.0002 per step in the sensor's unit (strength 0.00088 to 0.0107)"


def episodes(changed, rows=200, onset=60, sensors=None):
    """An episode of CartPole with some sensors changed from the onset on, and its twin of zeros."""
    twin = np.zeros((rows, 4), np.float32)
    broken = twin.copy()
    for sensor, value in changed.items():
        broken[onset:, sensor] = value
    nothing = Episode(Trajectory(twin), np.zeros(rows - 1, np.float32), False, 1)
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
    assert twin[0] == (pictures.LEFT, pictures.BOTTOM)
    assert twin[:30] == broken[:30]
    assert {y for _, y in twin} == {pictures.BOTTOM}
    assert {y for _, y in broken[30:]} == {pictures.TOP}
    assert broken[-1] == (pictures.RIGHT, pictures.TOP)
    assert "<circle" not in drawn


def test_a_plot_lasts_until_the_effect_is_seen():
    broken, twin = episodes({0: 1.0}, rows=400, onset=200)
    drawn = pictures.plot("cartpole", "", replace(broken, onset=60), twin)
    assert re.findall(r">(\d+)</text>", drawn) == ["0", "1", "30", "290"]
    assert ">onset, step 60<" in drawn


def test_labels_are_short_plain_numbers():
    drawn = pictures.plot("cartpole", "", *episodes({0: -123.4}))
    assert re.findall(r">(-?[\d.e+]+)</text>", drawn)[:2] == ["-120", "0"]
    negative_zero = pictures.plot("cartpole", "", *episodes({0: -0.0}))
    assert ">-0<" not in negative_zero


def test_a_dot_marks_the_end_of_an_episode():
    broken, twin = episodes({0: 1.0})
    short = replace(broken, trajectory=Trajectory(broken.trajectory.observations[:91]))
    drawn = pictures.plot("cartpole", "", short, twin)
    # Row 90 is half-way from row 30 to row 150.
    middle = (pictures.LEFT + pictures.RIGHT) / 2
    assert f'<circle cx="{middle:.1f}" cy="{pictures.TOP:.1f}"' in drawn


def test_png_files_hold_the_picture(tmp_path):
    image = np.random.default_rng(0).integers(256, size=(7, 5, 3)).astype(np.uint8)
    (tmp_path / "a.png").write_bytes(pictures.png(image))
    read = matplotlib.image.imread(tmp_path / "a.png")
    assert np.array_equal((255 * read).round(), image)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_frames_show_the_environment(environment):
    read = matplotlib.image.imread(PAGES / f"{environment}.png")
    height, width, _ = read.shape
    assert 200 <= height <= 250
    assert 250 <= width <= 320
    assert len(np.unique(read.reshape(-1, 3), axis=0)) > 5  # more than ground and sky
