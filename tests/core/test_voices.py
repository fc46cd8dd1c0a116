"""Voices: what each statistic of a detector costs the alarm, and who says so."""

import numpy as np
import pytest
from helpers_plugins import install, local_spec
from oodd_live import Watchdog

from oodd_eval import Trajectory, evaluate
from oodd_eval.cli.main import main
from oodd_eval.errors import ContractError
from oodd_eval.plugins.voices import (
    FAULTS,
    MOST_ROWS,
    VoiceCost,
    VoiceCosts,
    costs_of_voices,
    first_rows,
    injected_faults,
)
from oodd_eval.results.directory import ResultsDirectory

PLUGIN = '''
import numpy as np
from oodd_eval import DetectorSpec, hookimpl


class Two:
    """Changes of readings, and a voice that is loud in a fifth of all episodes."""
    def __init__(self, *, loud=True): self.loud = loud
    def fit(self, nominal):
        changes = np.concatenate([np.diff(x.observations, axis=0) for x in nominal])
        self.scale = np.abs(changes).max(axis=0) + 1e-9
        self.high = np.quantile([*map(self.first, nominal)], 0.8)
    def first(self, x):
        return x.observations[0].astype(float).sum()
    def voices(self, x):
        steps = np.abs(np.diff(x.observations.astype(float), axis=0)) / self.scale
        changes = np.concatenate([[np.nan], steps.max(axis=1)])
        rare = np.full(len(x), 0.1)
        if self.loud and self.first(x) > self.high:
            rare[-1] = 1e6
        return {"changes": changes, "rare": rare}
    def score(self, x):
        return np.fmax(*self.voices(x).values())


class Even(Two):
    def __init__(self): super().__init__(loud=False)


class Wrong(Two):
    def voices(self, x): raise RuntimeError("nothing to say")
    def score(self, x): return np.fmax(*super().voices(x).values())


@hookimpl
def oodd_detectors():
    return [DetectorSpec(c.__name__.lower(), c, "", alarm="score") for c in (Two, Even, Wrong)]
'''
SENTENCE = "`rare` sets the threshold at 5 %; `changes` alone would find"


def walk(seed, rows=200, sensors=3):
    rng = np.random.default_rng(seed)
    return Trajectory(rng.normal(size=(rows, sensors)), rng.normal(size=(rows - 1, 1)))


class Sizes:
    """The largest reading, and a voice that shouts in the first rows of some episodes."""

    def __init__(self, loud=()):
        self.loud = loud

    def fit(self, nominal): ...

    def score(self, x): ...

    def voices(self, x):
        rows = x.observations.astype(float)
        shouts = np.zeros(len(x))
        shouts[1] = 1e3 if float(rows[0, 0]) in self.loud else 0.0
        return {"sizes": np.abs(rows).max(axis=1), "shouts": shouts}


# Costs


def test_a_voice_that_shouts_in_nominal_episodes_costs_what_another_would_find():
    episodes = [walk(i) for i in range(40)]
    quiet = costs_of_voices(Sizes(), episodes, 0.05)
    assert quiet.alone == {"sizes": quiet.together, "shouts": VoiceCost(0.0, 0.0)}
    assert str(quiet) == ""
    loud = [float(x.observations[0, 0]) for x in episodes[:3]]
    costs = costs_of_voices(Sizes(loud), episodes, 0.05)
    assert costs.together == VoiceCost(1e3, 0.0)
    assert costs.alone == {"sizes": quiet.together, "shouts": VoiceCost(1e3, 0.0)}
    assert str(costs) == (
        "`shouts` sets the threshold at 5 %; `sizes` alone would find "
        f"{100 * quiet.together.share:.0f} % of injected faults, all together 0 %"
    )
    assert VoiceCosts.of(costs.values()) == costs
    # One of forty may be loud, which leaves the other voice none.
    few = costs_of_voices(Sizes(loud[:1]), episodes, 0.05)
    assert quiet.together.threshold < few.together.threshold < 1e3
    assert str(few).startswith("`shouts` sets the threshold")


def test_a_cost_of_up_to_three_points_is_not_spoken_of():
    alone = {"a": VoiceCost(1.0, 0.53), "b": VoiceCost(2.0, 0.1)}
    assert str(VoiceCosts(0.05, VoiceCost(2.0, 0.5), alone)) == ""
    assert str(VoiceCosts(0.05, VoiceCost(2.0, 0.49), alone)) != ""
    assert str(VoiceCosts(0.05, VoiceCost(2.0, 0.4), {"a": alone["a"]})) == ""


def test_there_are_costs_only_of_voices_and_where_episodes_suffice():
    episodes = [walk(i) for i in range(40)]
    assert costs_of_voices(object(), episodes) is None
    assert costs_of_voices(Sizes(), episodes).level == 0.05
    assert costs_of_voices(Sizes(), episodes[:18]).level == 0.1
    assert costs_of_voices(Sizes(), episodes[:18], 0.05) is None
    assert costs_of_voices(Sizes(), episodes[:8]) is None
    assert costs_of_voices(Sizes(), [walk(i, rows=5) for i in range(40)]) is None


@pytest.mark.parametrize("start", [0, 60])
def test_faults_begin_in_nominal_episodes_and_last_twenty_rows(start):
    episodes = [walk(i) for i in range(19)]
    pairs, ways = [*injected_faults(episodes, start)], set()
    assert len(pairs) == FAULTS
    for i, (faulty, onset) in enumerate(pairs):
        nominal = episodes[i % 19]
        assert start + 35 <= onset < start + 100
        assert len(faulty) == onset + 20
        np.testing.assert_array_equal(faulty.observations[:onset], nominal.observations[:onset])
        np.testing.assert_array_equal(faulty.actions, nominal.actions[: onset + 19])
        rows, before = faulty.observations[onset:], nominal.observations[onset : onset + 20]
        moved = (rows != before).any(axis=0)
        assert 1 <= moved.sum() <= 2
        by = (rows - before)[:, moved]
        stuck = (rows[:, moved] == faulty.observations[onset - 1, moved]).all()
        ways.add("stuck" if stuck else "shifted" if by.std(axis=0).max() < 1e-5 else "noisy")
        assert stuck or np.abs(by).max() < 20
    assert ways == {"stuck", "shifted", "noisy"}
    for (one, _), (other, _) in zip(pairs, injected_faults(episodes, start), strict=True):
        np.testing.assert_array_equal(one.observations, other.observations)


def test_few_rows_suffice():
    episodes = [walk(i, rows=1000) for i in range(100)]
    nominal = [*first_rows(episodes)]
    assert sum(map(len, nominal)) == MOST_ROWS
    assert sum(len(x) for x, _ in injected_faults(nominal)) <= FAULTS * 120


@pytest.mark.parametrize(
    "returned", [{}, {"a": np.zeros(3)}, {"a": np.zeros((200, 1))}, {"a": ["x"] * 200}]
)
def test_what_are_no_voices_is_refused(returned):
    detector = Sizes()
    detector.voices = lambda _: returned
    with pytest.raises(ContractError):
        costs_of_voices(detector, [walk(i) for i in range(19)])


# A run


@pytest.fixture
def plugin(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "plugin", "voiced", PLUGIN, header="")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "plugin"))


@pytest.mark.usefixtures("plugin")
def test_the_whole_report_of_a_run_says_which_voice_costs_the_alarm(tmp_path, capsys):
    output = str(tmp_path / "out")
    arguments = ["--env", "hopper", "--anomaly", "iid", "--output", output]
    assert main(["run", "--detector", "two,even,wrong", *arguments]) == 1
    assert "sets the threshold" not in capsys.readouterr().out
    assert main(["show", output, "--wide"]) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert f"hopper, two[h=1,seed=0]: {SENTENCE}" in printed
    assert printed.count("sets the threshold") == 1
    assert "sets the threshold" in (tmp_path / "out" / "report.md").read_text()
    results = ResultsDirectory(output)
    records = {record.detector: record for record in results.records()}
    assert "RuntimeError: nothing to say" in records["wrong"].reason
    said = {name: results.voices(record.scores) for name, record in records.items()}
    costs = {name: VoiceCosts.of(said[name]) for name in ("two", "even")}
    assert costs["two"].together.share < costs["two"].alone["changes"].share
    assert costs["even"].together == costs["even"].alone["changes"]
    # A further anomaly, scored with the same fit, leaves it there.
    assert main(["run", "--detector", "two", *arguments[:3], "iid,drift", *arguments[4:]]) == 0
    assert main(["show", output, "--wide"]) == 1
    assert SENTENCE in " ".join(capsys.readouterr().out.split())
    here = evaluate(
        local_spec("two"), environments="hopper", anomalies="iid", output=tmp_path / "b"
    )
    values = ResultsDirectory(tmp_path / "b").voices(here[0].scores)
    assert VoiceCosts.of(values) == costs["two"]


# A watchdog


@pytest.mark.filterwarnings("ignore:.*has no update")
def test_a_watchdog_has_the_costs_of_its_voices(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "voiced", PLUGIN, header="")
    episodes = [walk(i) for i in range(60)]
    calibration = episodes[20:]
    watchdog = Watchdog.fit("even", episodes[:20], calibration)
    assert watchdog.voices.together == watchdog.voices.alone["changes"]
    assert not any("sets the threshold" in note for note in watchdog.notes)
    assert Watchdog.fit("mewma", episodes[:20], calibration).voices is None
    watchdog = Watchdog.fit("two", episodes[:20], calibration)
    assert any(SENTENCE in note for note in watchdog.notes)
