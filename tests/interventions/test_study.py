"""Studies: the same files for any number of processes and after an interrupt, failures reported."""

import functools
import importlib
import json
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_plugins import install
from oodd_interventions import ActSpec, study
from oodd_interventions.acts import ACTS
from oodd_interventions.study import suiting
from oodd_recording.build import build_split
from oodd_worlds.acts import ACTS as WORLDS

from oodd_eval import Trajectory, intervene
from oodd_eval.data.facts import SplitDefinition
from oodd_eval.data.offers import OfferedSpecs
from oodd_eval.data.registry import EnvironmentSpec
from oodd_eval.errors import SimulationError, UnknownNameError, UsageError
from oodd_eval.scoring.plan import source_digest

KINDS = "iid,shutdown,wind-l2r"
STUDY = {"kinds": KINDS, "seeds": 3, "jobs": 1, "acts": "mask"}


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    definition = SplitDefinition(
        "small", train=8, calibration=38, test=1, episode_cap=120, seed_base=5
    )
    return build_split(definition, tmp_path_factory.mktemp("split"), environments=["cartpole"])


def cells_of(output):
    """What is in the files of cells, but for time and machine."""
    cells = {}
    for file in sorted((output / "cells").rglob("*")):
        if file.is_file():
            cell = json.loads(file.read_text())
            del cell["provenance"], cell["seconds"]
            cells[str(file.relative_to(output))] = cell
    return cells


@pytest.fixture(scope="module")
def whole(split, tmp_path_factory):
    """A study that nothing interrupts."""
    output = tmp_path_factory.mktemp("study")
    return intervene("mewma-a,mahalanobis", "cartpole", split=split, output=output, **STUDY)


@pytest.mark.slow
def test_files_and_cells_of_a_study(whole):
    assert whole.reasons == {}
    cells = cells_of(whole.output)
    names = [f"cells/cartpole/{d}/{k}--mask.json" for d in ("mahalanobis", "mewma-a")
             for k in ("iid", "shutdown")]  # fmt: skip
    assert list(cells) == names
    cell = cells[names[-1]]
    identity = {"schema": "oodd-eval/intervention/1", "act": "mask", "level": 0.05, "cap": 120}
    assert identity.items() <= cell.items()
    assert [e["seed"] for e in cell["episodes"]] == [680_000_000 + k for k in range(3)]
    returns = [[e["returns"][arm] for e in c["episodes"]] for c in whole.cells
               for arm in ("oracle", "watchdog")]  # fmt: skip
    assert all(sum(a) >= sum(b) for a, b in zip(returns[::2], returns[1::2], strict=True))
    # Twin, never and oracle are the same for all detectors.
    for kind in ("iid", "shutdown"):
        of = [cells[f"cells/cartpole/{d}/{kind}--mask.json"] for d in ("mahalanobis", "mewma-a")]
        for arm in ("twin", "never", "oracle"):
            assert len({tuple(e["returns"][arm] for e in c["episodes"]) for c in of}) == 1


@pytest.mark.slow
def test_an_interrupted_study_goes_on_and_has_the_same_files(whole, split, tmp_path):
    heard = []

    def interrupt(done, total, text):
        heard.append((done, total))
        if done:
            raise KeyboardInterrupt

    names = ("mewma-a,mahalanobis", "cartpole")
    with pytest.raises(KeyboardInterrupt):
        intervene(*names, split=split, output=tmp_path, observer=interrupt, **STUDY)
    assert heard[-1] == (2, 4)
    fits = {f: f.stat().st_mtime_ns for f in (tmp_path / "fits").rglob("*.npz")}
    assert fits
    damaged = tmp_path / "cells/cartpole/mewma-a/iid--mask.json"
    damaged.write_text(damaged.read_text()[:-9] if damaged.exists() else "")
    later = []
    again = intervene(
        *names, split=split, output=tmp_path, observer=lambda *a: later.append(a[:2]),
        **(STUDY | {"jobs": 2}),
    )  # fmt: skip
    assert cells_of(tmp_path) == cells_of(whole.output)
    assert len(again.cells) == 4
    assert {f: f.stat().st_mtime_ns for f in (tmp_path / "fits").rglob("*.npz")} == fits
    assert later[-1] == (4, 4)


@pytest.mark.slow
def test_a_threshold_is_not_taken_from_a_study_with_other_scores(split, tmp_path):
    """The weight decides the scores of `rf-ewma`, but not its fit."""
    settings = STUDY | {"kinds": "iid", "seeds": 2, "split": split}
    forest = {"members": 2, "trees": 1}
    alarms = []
    for directory, weight in (("a", 0.03), ("a", 1.0), ("b", 1.0)):
        output, values = tmp_path / directory, forest | {"weight": weight}
        made = intervene("rf-ewma", "cartpole", output=output, parameters=values, **settings)
        alarms.append([(e["alarm"], e["false_alarm"]) for e in made.cells[0]["episodes"]])
    assert alarms[0] != alarms[1] == alarms[2]


@pytest.mark.slow
def test_seeds_and_level_are_those_asked_for_and_fresh_fits_again(split, tmp_path):
    settings = STUDY | {"kinds": "iid", "split": split, "output": tmp_path, "base": 7}
    alarms = []
    for level in (0.05, 0.6):
        [cell] = intervene("mahalanobis", "cartpole", level=level, **settings).cells
        assert [e["seed"] for e in cell["episodes"]] == [7_000_000 + k for k in range(3)]
        alarms.append([e["alarm"] for e in cell["episodes"]])
    rows = [[120 if row is None else row for row in of] for of in alarms]
    assert all(often <= rare for rare, often in zip(*rows, strict=True))
    assert rows[0] != rows[1]
    files = [f for f in tmp_path.rglob("*") if f.suffix == ".json" or "-60." in f.name]
    before = {f: f.stat().st_mtime_ns for f in files}
    assert len(before) == 2
    intervene("mahalanobis", "cartpole", level=0.6, fresh=True, **settings)
    assert all(f.stat().st_mtime_ns > time for f, time in before.items())


def test_short_twins_give_way_to_the_next_seed(monkeypatch, tmp_path):
    def record(seed):
        rows = np.zeros((40 if seed % 2 else 60, 4), np.float32)
        return SimpleNamespace(seed=seed, trajectory=Trajectory(rows))

    loop = SimpleNamespace(setup=SimpleNamespace(record=record))
    monkeypatch.setattr(study, "_loop", lambda *_: loop)
    twins = study._twins(study.Study(tmp_path, tmp_path, 3, 7, 0.05), "cartpole")
    assert [twin.seed for twin in twins] == [7_000_000, 7_000_002, 7_000_004]
    monkeypatch.setattr(study, "SHORTEST_TWIN", 61)
    with pytest.raises(SimulationError, match="only 0 have nominal episodes of 61 transitions"):
        study._twins(study.Study(tmp_path, tmp_path, 2, 7, 0.05), "cartpole")


PLUGIN = """
from oodd_interventions import ActSpec

class Failing(Good):
    def fit(self, nominal):
        raise ValueError("no fit today")

class Leaving(Good):
    def fit(self, nominal):
        raise SystemExit(4)

class Dying(Good):
    def fit(self, nominal):
        os._exit(3)

class Still:
    def __init__(self, situation):
        self.row = len(situation.rows) - 1
    def act(self, row):
        if self.row < 0:
            raise RuntimeError
        return 0

@hookimpl
def oodd_detectors():
    missing = DetectorSpec("missing", Good, "a test's", requires=("no_such_module",))
    return [*offer(failing=Failing, leaving=Leaving, dying=Dying, good=Good), missing]

@hookimpl
def oodd_acts():
    return [ActSpec("still", Still, "the first command", ("dynamics",), ("cartpole",))]
"""


@pytest.mark.slow
def test_what_fails_is_reported_and_the_others_go_on(split, tmp_path, monkeypatch):
    install(monkeypatch, tmp_path / "plugin", "acting", PLUGIN)
    settings = STUDY | {"acts": "mask,still", "kinds": "iid,wind-l2r"}
    output = tmp_path / "study"
    made = intervene(
        "failing,leaving,good,missing", "cartpole", split=split, output=output, **settings
    )
    assert [(c["detector"], c["anomaly"], c["act"]) for c in made.cells] == [
        ("good", "iid", "mask"),
        ("good", "wind-l2r", "still"),
    ]
    assert made.reasons["cartpole/failing"] == "ValueError: no fit today"
    assert made.reasons["cartpole/leaving"] == "SystemExit: 4"
    assert "no_such_module" in made.reasons["cartpole/missing"]
    # It does not explain, so that it names nothing and its mask changes nothing.
    masked, still = (cell["episodes"] for cell in made.cells)
    assert all(e["returns"]["watchdog"] == e["returns"]["never"] for e in masked)
    assert all(e["named"].get("0", {}).get("kind", "") == "" for e in masked)
    assert any(e["acted"]["watchdog"] is not None for e in still)
    with pytest.raises(SimulationError, match="a process of the study ended all at once"):
        intervene("dying", "cartpole", split=split, output=output, **settings)


def test_wrong_names_and_the_base_of_the_split_are_refused(split, tmp_path):
    with pytest.raises(UsageError, match="base=5 is that of split"):
        intervene("mewma-a", "cartpole", split=split, base=5, output=tmp_path)
    with pytest.raises(UnknownNameError, match="act"):
        intervene("mewma-a", "cartpole", split=split, acts="mosk", output=tmp_path)
    with pytest.raises(UsageError, match=r"column:cart velocity is a column .* closed loop"):
        intervene("mewma,column:cart velocity", "cartpole", split=split, output=tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_code_of_a_foreign_act_is_part_of_what_a_cell_is_of(tmp_path, monkeypatch):
    digests = set()
    for code in ("def make(situation): ...", "def make(situation): return None"):
        install(monkeypatch, tmp_path, "editing", code)
        make = importlib.import_module("oodd_editing").make
        source_digest.cache_clear()
        for function in (make, functools.partial(make)):
            digests.add(study.source_of(ActSpec("edited", function, "", ("dynamics",))))
    assert len(digests) == 2
    assert "" not in digests
    assert {study.source_of(act) for act in (*ACTS, *WORLDS)} == {""}


BROKEN = """
@hookimpl
def oodd_acts():
    return ["brake"]
"""


def test_acts_of_a_broken_plugin_are_not_passed_over_in_silence(split, tmp_path, monkeypatch):
    install(monkeypatch, tmp_path / "plugin", "braking", BROKEN)
    settings = {"split": split, "output": tmp_path / "study", "seeds": 1, "jobs": 1}
    with pytest.raises(UsageError, match=r"unknown act 'brake'.*plug-in 'braking'.*'brake'"):
        intervene("mahalanobis", "cartpole", acts="brake", **settings)
    [plugin] = intervene(
        "mahalanobis", "cartpole", acts="mask", kinds="wind-l2r", **settings
    ).reasons
    assert plugin.startswith("plug-in 'braking'")


@pytest.mark.parametrize(
    "setting", [{"seeds": 0}, {"seeds": 1.5}, {"base": -1}, {"level": 5}, {"level": 0}], ids=str
)
def test_numbers_that_make_no_study_are_refused(setting, split, tmp_path):
    [name] = setting
    with pytest.raises(UsageError, match=f"^{name} is"):
        intervene("mahalanobis", "cartpole", split=split, output=tmp_path, **setting)


def test_an_act_of_the_environment_takes_the_place_of_a_general_one():
    general = ActSpec("stop", None, "", ("sensor", "dynamics"))
    special = ActSpec("stop", None, "", ("dynamics",), ("cartpole",))
    other = ActSpec("switch", None, "", ("dynamics",), ("hopper",))
    acts = [(act, "mine") for act in (special, general, other)]
    chosen = functools.partial(suiting, acts, ["stop", "switch"], OfferedSpecs())
    assert chosen(environment_of("cartpole"), "dynamics") == (special,)
    assert chosen(environment_of("cartpole"), "sensor") == (general,)
    assert chosen(environment_of("hopper"), "dynamics") == (general, other)


def environment_of(name, plugin=""):
    return EnvironmentSpec(name, None, None, (), (), 9, plugin=plugin)


def test_acts_of_plugins_are_for_their_own_environments_and_clashes_break_none():
    """Three plug-ins have a `tank` and stop it; two have a general act `pause`."""
    plugins = ("one", "two", "worlds")
    specs = OfferedSpecs(tuple(environment_of("tank", plugin) for plugin in plugins))
    stops = {p: ActSpec("stop", None, p, ("dynamics",), ("tank",)) for p in plugins}
    pauses = {p: ActSpec("pause", None, p, ("dynamics",)) for p in ("one", "two")}
    shipped = ActSpec("mask", None, "shipped", ("dynamics",))
    mask = ActSpec("mask", None, "one", ("dynamics",))
    offered = [(shipped, ""), *((act, p) for p, act in stops.items()), (mask, "one")]
    offered += [(act, p) for p, act in pauses.items()]

    def chosen(names, plugin):
        return suiting(offered, names, specs, environment_of("tank", plugin), "dynamics")

    for plugin in plugins:
        assert chosen(["stop"], plugin) == (stops[plugin],)
    assert chosen(["worlds/stop"], "one") == ()
    assert chosen(["stop", "pause", "mask"], "one") == (mask, stops["one"], pauses["one"])
    assert chosen(["mask"], "two") == chosen(["mask"], "worlds") == (shipped,)
    assert chosen(["one/mask"], "two") == (mask,)
    assert chosen(["two/pause"], "worlds") == (pauses["two"],)
    with pytest.raises(UsageError, match="one/pause and two/pause"):
        chosen(["pause"], "worlds")
