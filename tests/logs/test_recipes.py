"""Recipes of public logs, each on small files of the shape of its set that the test writes."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from helpers_public_logs import WRITERS
from oodd_logs.importing import import_recipe
from oodd_logs.recipe import Recipe
from oodd_logs.shipped_recipes import shipped_recipes

from oodd_eval import evaluate, load_split
from oodd_eval.cli.main import main

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("public_logs", ROOT / "benchmarks/public_logs.py")
public_logs = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(public_logs)

SETS = {
    # Windows of 250 s: 8 of the nominal recording, 2 of each file before that with its fault.
    # Those that begin within the fault have no baseline, and so has other/2 behind its gap.
    "skab": (1, (6, 7, 3), {"valve1": 3, "valve2": 1},
             {"valve1": [[(100, 250)]] * 3, "valve2": [[(100, 250)]]}),
    # Windows of 10 s: 5 of each flight without a failure, 4 before each of the two failures.
    # Rows are counted from the first one in which every sensor has spoken: the fifth.
    "alfa": (20, (10, 20, 8), {"engine": 2 + 2},
             {"engine": [[(846 - 800, 200)], [(0, 200)], [(896 - 800, 200)], [(0, 186)]]}),
    # 800 rows in 12.784 s are 768 at 60 Hz: 25 windows each of two healthy runs. Of the 576 of the
    # faulty one, 15 windows have anomalous rows, the last one being shorter.
    "rosa": (60, (20, 30, 5), {"damping": 15}, {}),
    "tep": (1 / 180, (11, 17, 5), {"fault-05": 4}, {"fault-05": [[(0, 20)]] * 4}),
    # Tasks are shared out each for itself; lp3 is lp2 again and is left out.
    "uci": (47.62, (22, 24, 19), {"collision": 4, "fr_collision": 3, "left_col": 3,
                                  "obstruction": 5}, {"collision": [[(0, 15)]] * 4}),
    # Windows of 1200 rows; the variables are called by the number of their file.
    "cwru": (12000, (6, 4, 5), {"inner-race": 2, "ball": 2}, {"ball": [[(0, 1200)]] * 2}),
    # 157 windows of half a day, five of which have rows of each label.
    "nab": (1 / 300, (55, 41, 41), {"failure": 20}, {}),
    # Two pieces of 799 s, 39 windows each, some with a stop or a lost grip, none with both. Those
    # that begin with one have no nominal beginning and are left out.
    "ur3": (1, (26, 30, 18), {"protective-stop": 1, "grip-lost": 1},
            {"protective-stop": [[(10, 14)]]}),
    "lerobot": (30, (4, 4, 2), {}, {}),
    # Failures are known by their outcome alone; tasks are shared out each for itself.
    "pi0": (None, (2 * 16, 2 * 14, 2 * 10), {"failure": 2 * 10}, {"failure": [[]] * 20}),
    # Half of each task's failures are for training.
    "pi0-failures": (None, (2 * 16, 2 * 14, 2 * 10), {"failure": 2 * 5}, {"failure": [[]] * 10}),
}  # fmt: skip
"""Rate in Hz, episodes of the nominal parts and of each anomaly, and intervals of some."""


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """Return a function that imports a set from files of its shape, once."""
    known = {}

    def of(name):
        if name not in known:
            root = tmp_path_factory.mktemp(name)
            (root / "logs").mkdir()
            WRITERS[name](root / "logs")
            recipe = Recipe.load(shipped_recipes()[name])
            split = import_recipe(recipe, root / "logs", root / "split")
            known[name] = root, split.environment(recipe.environment)
        return known[name]

    return of


def sizes(data):
    """Numbers of episodes: training, calibration, nominal test, and of each anomaly."""
    nominal = (len(data.train), len(data.calibration), len(data.twins))
    return nominal, {a: len(data.labelled(a)) for a in data.anomalies}


def test_every_set_has_a_writer_and_its_sizes():
    # What learns from failures has a page of its own.
    assert {*shipped_recipes()} == {*WRITERS} == {*SETS} == {*public_logs.ORDER, "pi0-failures"}


def test_the_page_has_the_committed_records_and_what_they_are_of():
    assert public_logs.main(["--check"]) == 0


@pytest.mark.parametrize("name", WRITERS)
def test_a_recipe_imports_the_episodes_of_its_set(name, imported):
    rate, nominal, anomalous, intervals = SETS[name]
    recipe = Recipe.load(shipped_recipes()[name])
    _, data = imported(name)
    assert sizes(data) == (nominal, anomalous)
    for anomaly, expected in intervals.items():
        assert [list(one) for one in data.labelled(anomaly).intervals] == expected
    facts = data.logs
    assert recipe.source.startswith("https://")
    assert all((recipe.licence, recipe.citation))
    assert (facts.source, facts.licence, facts.citation) == (
        recipe.source, recipe.licence, recipe.citation,
    )  # fmt: skip
    assert facts.paired is False
    assert facts.rate == (None if rate is None else pytest.approx(rate))


def test_columns_and_names_of_some_sets(imported):
    (_, skab), (_, alfa), (_, rosa), (_, cwru) = map(imported, ("skab", "alfa", "rosa", "cwru"))
    assert {len(x) for part in (skab.train, skab.labelled("valve1")) for x in part} == {250}
    assert skab.logs.baseline == 80
    assert skab.labelled("valve1").names[1].startswith("2")  # not 10
    assert len(alfa.sensors) == 25 + 1  # a heading is a sine and a cosine
    assert [q.name for q in rosa.actions] == ["Desired Speed"]
    assert "Mag. x" in [q.name for q in rosa.sensors]
    assert [q.name for q in cwru.sensors] == ["drive end", "fan end"]
    root, tep = imported("tep")
    assert (len(tep.sensors), len(tep.actions), tep.sensors[8].unit) == (41, 11, "°C")
    matrix = np.loadtxt(root / "logs" / "d00.dat")  # the transposed one
    assert tep.train[1].observations[3] == pytest.approx(matrix[:41, 23], rel=1e-5)
    tasks = list(imported("uci")[1].twins.tasks)
    assert {task: tasks.count(task) for task in tasks} == {"lp1": 6, "lp2": 6, "lp4": 7}
    assert imported("nab")[1].labelled("failure").intervals[0] == ((2126 - 14 * 144, 144),)
    # The last row's action led to nothing that was recorded.
    first = imported("lerobot")[1].train[0]
    assert (first.observations.shape, first.actions.shape) == ((160, 26), (159, 26))
    pi0, failures = imported("pi0")[1], imported("pi0-failures")[1]
    failed, left, learnt = pi0.labelled("failure"), failures.labelled("failure"), failures.failures
    assert ({*failed.tasks}, pi0.failures) == ({"0", "2"}, None)
    assert learnt.names == (*failed.names[:5], *failed.names[10:15])
    assert left.names == (*failed.names[5:10], *failed.names[15:])
    for part in ("train", "calibration", "twins"):
        assert getattr(pi0, part).names == getattr(failures, part).names


@pytest.mark.parametrize("name", WRITERS)
def test_rows_run_on_a_set(name, imported, tmp_path, capsys):
    root, data = imported(name)
    arguments = ["run", "--detector", "mewma,mahalanobis,range,clock", "--env", "all"]
    directory = root / "split"
    assert main([*arguments, "--split", str(directory), "--output", str(tmp_path / "results")]) == 0
    printed = capsys.readouterr().out
    assert all(row in printed for row in ("mewma", "mahalanobis", "range", "clock"))
    records = (tmp_path / "results" / "records.jsonl").read_text().splitlines()
    cells = [json.loads(line) for line in records]
    assert {cell["status"] for cell in cells} == {"ok"}
    assert len(cells) == 4 * max(1, len(data.anomalies))


def test_the_clock_finds_nothing_in_outcomes(imported, tmp_path):
    """Failures last longer, but up to the same row a clock cannot tell them from successes."""
    root, data = imported("pi0")
    assert data.twins.lengths.max() < data.labelled("failure").lengths.min()
    (record,) = evaluate("clock", root / "split", output=tmp_path)
    assert record.metrics["auc_outcome"].value == 0.5
    assert record.metrics["auc_pool"].value == 0.5


def test_a_recipe_comes_by_its_name(tmp_path, monkeypatch):
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "splits"))
    (tmp_path / "logs").mkdir()
    WRITERS["uci"](tmp_path / "logs")
    assert main(["data", "import", "uci", "--root", str(tmp_path / "logs")]) == 0
    assert load_split("uci").environment("uci").logs.licence == "CC BY 4.0"
