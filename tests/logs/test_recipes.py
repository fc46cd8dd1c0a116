"""Recipes of public logs, each on small files of the shape of its set that the test writes."""

import importlib.util
import json
import re
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

RATES = {"skab": 1, "alfa": 20, "rosa": 60, "tep": 1 / 180, "uci": 47.62, "cwru": 12000,
         "nab": 1 / 300, "ur3": 1, "lerobot": 30, "pi0": None}  # fmt: skip


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


def intervals(data, anomaly):
    return [list(one) for one in data.labelled(anomaly).intervals]


def test_every_set_has_a_writer_and_its_rate():
    assert {*shipped_recipes()} == {*WRITERS} == {*RATES} == {*public_logs.ORDER}


@pytest.mark.parametrize("name", WRITERS)
def test_a_recipe_says_where_its_set_is_from(name, imported):
    recipe = Recipe.load(shipped_recipes()[name])
    _, data = imported(name)
    assert recipe.source.startswith("https://")
    facts = data.logs
    assert (facts.source, facts.licence, facts.citation) == (
        recipe.source, recipe.licence, recipe.citation,
    )  # fmt: skip
    assert all((recipe.licence, recipe.citation))
    assert facts.paired is False
    assert facts.rate == (None if RATES[name] is None else pytest.approx(RATES[name]))


def test_skab(imported):
    """Windows of 250 s: 8 of the nominal recording, 2 of each file before that with its fault.

    Windows that begin within the fault have no baseline, and so has other/2 behind its gap.
    """
    _, data = imported("skab")
    (train, calibration, nominal), anomalous = sizes(data)
    assert (train, calibration, nominal) == (6, 7, 3)  # of 8 + 4 * 2
    assert anomalous == {"valve1": 3, "valve2": 1}
    assert intervals(data, "valve1") == [[(100, 250)]] * 3
    assert intervals(data, "valve2") == [[(100, 250)]]
    assert {len(x) for part in (data.train, data.labelled("valve1")) for x in part} == {250}
    assert data.logs.baseline == 80
    assert data.labelled("valve1").names[1].startswith("2")  # not 10


def test_alfa(imported):
    """Windows of 10 s: 5 of each flight without a failure, 4 before each of the two failures."""
    _, data = imported("alfa")
    (train, calibration, nominal), anomalous = sizes(data)
    assert (train + calibration, nominal) == (6 * 5, 4 + 4)
    assert anomalous == {"engine": 2 + 2}
    # Rows are counted from the first one in which every sensor has spoken: the fifth.
    first, second, third, fourth = intervals(data, "engine")
    assert (first, second) == ([(846 - 800, 200)], [(0, 200)])
    assert (third, fourth) == ([(896 - 800, 200)], [(0, 186)])
    assert len(data.sensors) == 25 + 1  # a heading is a sine and a cosine


def test_rosa(imported):
    """800 rows in 12.784 s are 768 at 60 Hz: 25 windows each of two healthy runs.

    Of the 576 of the faulty one, 15 windows have anomalous rows, the last one being shorter.
    """
    _, data = imported("rosa")
    (train, calibration, nominal), anomalous = sizes(data)
    assert (train, calibration, nominal) == (20, 30, 5)
    assert anomalous == {"damping": 15}
    assert [q.name for q in data.actions] == ["Desired Speed"]
    assert "Mag. x" in [q.name for q in data.sensors]


def test_tep(imported):
    _, data = imported("tep")
    (train, calibration, nominal), anomalous = sizes(data)
    assert (train, calibration, nominal) == (11, 17, 5)  # of 10 windows and 23
    assert anomalous == {"fault-05": 4}
    assert intervals(data, "fault-05") == [[(0, 20)]] * 4
    assert (len(data.sensors), len(data.actions)) == (41, 11)
    assert data.sensors[8].unit == "°C"


def test_the_transposed_file_is_read_by_columns(imported):
    root, data = imported("tep")
    matrix = np.loadtxt(root / "logs" / "d00.dat")
    assert data.train[1].observations[3] == pytest.approx(matrix[:41, 23], rel=1e-5)


def test_uci(imported):
    """Tasks are shared out each for itself; lp3 is lp2 again and is left out."""
    _, data = imported("uci")
    (train, calibration, nominal), anomalous = sizes(data)
    assert train + calibration + nominal == 21 + 20 + 24
    assert anomalous == {"collision": 4, "fr_collision": 3, "left_col": 3, "obstruction": 5}
    tasks = list(data.twins.tasks)
    assert {task: tasks.count(task) for task in tasks} == {"lp1": 6, "lp2": 6, "lp4": 7}
    assert intervals(data, "collision") == [[(0, 15)]] * 4


def test_cwru(imported):
    """Windows of 1200 rows; the variables are called by the number of their file."""
    _, data = imported("cwru")
    nominal, anomalous = sizes(data)
    assert (nominal, anomalous) == ((6, 4, 5), {"inner-race": 2, "ball": 2})
    assert intervals(data, "ball") == [[(0, 1200)]] * 2
    assert [q.name for q in data.sensors] == ["drive end", "fan end"]


def test_nab(imported):
    """157 windows of half a day, five of which have rows of each label."""
    _, data = imported("nab")
    (train, calibration, nominal), anomalous = sizes(data)
    assert ((train, calibration, nominal), anomalous) == ((55, 41, 41), {"failure": 20})
    assert intervals(data, "failure")[0] == [(2126 - 14 * 144, 144)]


def test_ur3(imported):
    """Two pieces of 799 s, 39 windows each, some with a stop or a lost grip, none with both."""
    _, data = imported("ur3")
    (train, calibration, nominal), anomalous = sizes(data)
    assert anomalous == {"protective-stop": 2, "grip-lost": 2}
    assert train + calibration + nominal == 78 - 4
    assert intervals(data, "protective-stop") == [[(10, 14)], [(0, 11)]]
    assert len(data.sensors) == 19


def test_lerobot(imported):
    """Nominal episodes alone; the last row's action led to nothing that was recorded."""
    _, data = imported("lerobot")
    nominal, anomalous = sizes(data)
    assert (nominal, anomalous) == ((4, 4, 2), {})
    first = data.train[0]
    assert first.observations.shape == (60, 26)
    assert first.actions.shape == (59, 26)
    assert data.actions[0].unit == "rad"


def test_pi0(imported):
    """Failures are known by their outcome alone; tasks are shared out each for itself."""
    _, data = imported("pi0")
    (train, calibration, nominal), anomalous = sizes(data)
    assert (train, calibration, nominal) == (2 * 16, 2 * 14, 2 * 10)
    assert anomalous == {"failure": 2 * 10}
    assert intervals(data, "failure") == [[]] * 20
    assert {*data.labelled("failure").tasks} == {"0", "2"}


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


@pytest.mark.parametrize("name", WRITERS)
def test_the_page_has_the_card_of_the_recipe(name):
    advice = "run python benchmarks/public_logs.py"
    page = public_logs.PAGE.read_text()
    assert public_logs.filled(page, card={name: public_logs.card(name)}) == page, advice


def test_a_changed_card_is_seen():
    page = public_logs.PAGE.read_text()
    card = {"nab": public_logs.card("nab")}
    assert public_logs.filled(re.sub("hard about it", "easy", page), card=card) != page


def test_twins_that_were_made_up_give_no_matched_auc(tmp_path, capsys):
    """Nominal rows of another day are no twins: they differ before the fault already."""
    WRITERS["skab"](tmp_path)
    names = ("0.csv", "2.csv", "10.csv")
    header, *free = (tmp_path / "anomaly-free" / "anomaly-free.csv").read_text().splitlines()
    for folder in ("nominal", "twins", "faulty"):
        (tmp_path / folder).mkdir()
    for i in range(12):
        lines = [header, *free[50 * i : 50 * i + 50]]
        (tmp_path / "nominal" / f"{i:02}.csv").write_text("\n".join(lines))
    for i, name in enumerate(names):
        lines = [header, *free[700 + 300 * i : 1000 + 300 * i]]
        (tmp_path / "twins" / name).write_text("\n".join(lines))
        head, *rows = (tmp_path / "valve1" / name).read_text().splitlines()
        (tmp_path / "faulty" / name).write_text("\n".join([head, *rows[400:700]]))
    (tmp_path / "made-up.toml").write_text(
        """
        split = "made-up"
        sensors = ["Acc*", "Current", "Pressure", "Temperature", "Voltage"]
        labels = "anomaly"
        paired = true
        [read]
        format = "csv"
        [nominal]
        train = ["nominal/0[0-3].csv"]
        calibration = ["nominal/0[4-9].csv", "nominal/1*.csv"]
        twins = ["twins/*.csv"]
        [anomalous.fault]
        files = ["faulty/*.csv"]
        """
    )
    split = str(tmp_path / "split")
    assert main(["data", "import", str(tmp_path / "made-up.toml"), "--output", split]) == 0
    arguments = ["run", "--detector", "mahalanobis,clock", "--env", "all", "--split", split]
    assert main([*arguments, "--output", str(tmp_path / "results")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "auc_matched, auc_unpaired, auc_smoothed are withheld" in printed
    records = (tmp_path / "results" / "records.jsonl").read_text().splitlines()
    cells = {cell["detector"]: cell["metrics"] for cell in map(json.loads, records)}
    assert cells["mahalanobis"]["auc_before"]["value"] > 0.9
    assert "auc_matched" not in cells["mahalanobis"]
    assert cells["clock"]["auc_before"]["value"] == 0.5
    assert cells["clock"]["auc_matched"]["value"] == 0.5
