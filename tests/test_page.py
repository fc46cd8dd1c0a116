"""The pages "Environments and anomalies": their text, pictures, words and numbers."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers_docs import ROOT
from oodd_recording.environments import make
from oodd_recording.record import RecordedEpisode

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.trajectory import Trajectory

sys.path.insert(0, str(ROOT / "docs" / "figures"))
import environments as page
import pictures

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


def test_overview_page_and_pictures_are_written(tmp_path):
    page.write_pages(tmp_path, environments=["cartpole"])
    written = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    plots = {f"environments/cartpole/{kind}.svg" for kind in ANOMALIES}
    pages = {"environments.md", "environments/cartpole.md", "environments/cartpole.png"}
    assert written == pages | plots


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
    assert twin[0] == (pictures.LEFT, pictures.BOTTOM)
    assert twin[:30] == broken[:30]
    assert {y for _, y in twin} == {pictures.BOTTOM}
    assert {y for _, y in broken[30:]} == {pictures.TOP}
    assert broken[-1] == (pictures.RIGHT, pictures.TOP)
    assert "<circle" not in drawn
