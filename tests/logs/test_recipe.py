"""Recipes: every key is read and checked, and a mistake is told with its key and the nearest."""

import dataclasses
import tomllib

import pytest
from oodd_logs.recipe import KEYS, Recipe, anomaly_name

from oodd_eval.errors import UnknownNameError, UsageError

WHOLE = """
split = "arm-logs"
environment = "arm"
source = "https://example.org"
licence = "CC BY 4.0"
citation = "Doe 2024"
time = "t[ms]"
dates = "day first"
rate = 100
gap = 2.5
episode = ["robot", "run"]
sensors = ["q*[rad]", "speed = v"]
actions = "cmd*"
reward = "r"
scores = "*_innov"
discrete = 3
angles = ["q6"]
constant = "drop"
missing = "hold"
missing_rows = 7
labels = "anomaly"
nominal_label = ["H", 0]
intervals = [["a.csv", 3, 9], ["b.csv", 2013-12-10T06:25:00, "", "leak"]]
onset = 10
stop = 20
outcome = "success"
failures = 0.5
kinds = "class"
task = "task_id"
unseen = [7, "stack"]
baseline = 100
window = 600
clock = false
order = "shuffled"
seed = 4
paired = false
blocks = {chunk = "q*"}
[roles]
angle = "q6"
[read]
format = "csv"
separator = ";"
[nominal]
files = ["free/*.csv"]
parts = [0.5, 0.5]
where = {class = "normal", day = [1, 2]}
window = 0
[anomalous.valve_1]
files = ["valve/*.csv"]
group = "sensor"
labels = "fault"
onset = 5
stop = 6
window = 50
where = {day = 3}
"""


def parse(text):
    return Recipe.parse(tomllib.loads(text))


def test_every_key_reaches_the_recipe(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text(WHOLE)
    recipe = Recipe.load(path)
    content = tomllib.loads(WHOLE)
    assert {*content} == {*KEYS, "angles"}
    plain = Recipe("arm-logs", "arm")
    same = {f.name for f in dataclasses.fields(recipe) if getattr(recipe, f.name) == getattr(plain, f.name)}  # fmt: skip  # noqa: E501
    assert same == {"split", "environment", "paired"}
    assert recipe.actions == ("cmd*",)
    assert (recipe.format, recipe.options) == ("csv", {"separator": ";"})
    assert recipe.intervals == (("a.csv", 3, 9, ""), ("b.csv", "2013-12-10T06:25:00", None, "leak"))
    assert recipe.nominal.where == {"class": ("normal",), "day": (1, 2)}
    valve = recipe.anomalous["valve_1"]
    assert (valve.group, valve.labels, valve.onset, valve.window) == ("sensor", ("fault",), 5, 50)
    assert recipe.label_columns == ("anomaly", "fault")


def test_the_least_recipe_has_an_environment_of_the_same_name():
    recipe = parse('split = "arm"\n[nominal]\nfiles = "*.csv"')
    assert (recipe.environment, recipe.nominal.parts) == ("arm", (0.4, 0.3, 0.3))


MINIMAL = 'split = "arm"\n{}\n[nominal]\nfiles = "*.csv"\n{}'


@pytest.mark.parametrize(
    ("top", "tables", "words"),
    [
        ('sensor = "x"', "", ["'sensor'", "did you mean 'sensors'"]),
        ("", 'train_files = "x"', ["[nominal]", "'train_files'"]),
        ("", '[anomalous.x]\ngrup = "sensor"', ["[anomalous.x]", "did you mean 'group'"]),
        ('missing = "holt"', "", ["missing", "did you mean 'hold'"]),
        ("rate = 0", "", ["rate is 0", "above 0"]),
        ("rate = true", "", ["rate is True"]),
        ("window = 1", "", ["window is 1", "from 2 on, or 0"]),
        ("baseline = 1", "", ["baseline is 1"]),
        ("clock = 1", "", ["clock is 1", "true or false"]),
        ("sensors = [1]", "", ["sensors is 1"]),
        ('intervals = [["a.csv", 1]]', "", ["intervals is ['a.csv', 1]"]),
        ("", "parts = [0.5, 0.4]", ["parts", "sum 1"]),
        ("", "parts = [1.0, 0.0]", ["parts"]),
        ("", '[anomalous.x]\nfiles = "../x.csv"', ["'../x.csv'", "--root"]),
        ("", '[anomalous.x]\nfiles = "/etc/x.csv"', ["'/etc/x.csv'", "--root"]),
        ("", '[anomalous."a b"]\nfiles = "x"', ["'a b' cannot be the name of an anomaly"]),
        ("", '[anomalous.nominal]\nfiles = "x"', ["'nominal'"]),
        ("", '[anomalous.iid]\nfiles = "x"\ngroup = "dynamics"', ["'iid'", "benchmark"]),
        ("", 'train = "x"\ncalibration = "y"', ["both files and parts"]),
        ("stop = 4", "", ["onset"]),
        ("gap = 4", "", ["gap", "time"]),
        ("", 'twins = "x"', ["paired = true"]),
        ("paired = true", '[anomalous.x]\nfiles = "x"', ["twins"]),
        ('paired = true\noutcome = "ok"', "", ["paired = true and outcome"]),
    ],
)
def test_a_mistake_is_told_with_its_key(top, tables, words):
    with pytest.raises(UsageError) as raised:
        parse(MINIMAL.format(top, tables))
    assert all(word in str(raised.value) for word in words), str(raised.value)


def test_names_of_the_benchmark_and_missing_parts_are_refused():
    for text, word in [
        ('[nominal]\nfiles = "x"', "lacks the key 'split'"),
        ('split = "mini"\n[nominal]\nfiles = "x"', "the benchmark's split"),
        ('split = "a"\nenvironment = "hopper"\n[nominal]\nfiles = "x"', "benchmark's environment"),
        ('split = "a"', "neither files nor train"),
        ('split = "a"\n[nominal]\ntrain = "x"', "calibration"),
    ]:
        with pytest.raises(UsageError, match=word):
            parse(text)


def test_a_file_that_is_no_recipe_is_refused(tmp_path):
    path = tmp_path / "arm.toml"
    for content in (b"split = ", b"\xff\xfe", b'split = "a\nb"'):
        path.write_bytes(content)
        with pytest.raises(UsageError, match=r"arm\.toml' cannot be read"):
            Recipe.load(path)
    with pytest.raises(UsageError, match=r"none\.toml' cannot be read"):
        Recipe.load(tmp_path / "none.toml")
    path.write_text("spilt = 'a'")
    with pytest.raises(UnknownNameError, match=r"arm\.toml"):
        Recipe.load(path)


def test_any_text_becomes_the_name_of_an_anomaly():
    assert anomaly_name("Front Collision (2)") == "front-collision-2"
    assert anomaly_name("fr_collision") == "fr_collision"
    assert anomaly_name("???") == "failure"
