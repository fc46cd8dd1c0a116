"""Attribution: explanations of detectors, what is kept of them, and the metrics that come of it."""

import h5py
import numpy as np
import pytest
from helpers_plugins import install

from oodd_eval import Explanation, Naming, Trajectory, evaluate, load_split
from oodd_eval.cli.main import main
from oodd_eval.data.parts import CALIBRATION, TWINS
from oodd_eval.errors import ContractError
from oodd_eval.metrics.alarms import (
    GuaranteedAlarm,
    attribution_contributions,
    naming_contributions,
)
from oodd_eval.metrics.auc import mean_of
from oodd_eval.metrics.bootstrap import bootstrap_weights, resampled
from oodd_eval.metrics.catalogue import ATTRIBUTION
from oodd_eval.plugins.explanations import explain_chunk, explains
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.evaluate import check_named, rescore, stored_scores

NAN = float("nan")
SENSOR_NAMED, ONSET_ERROR, PRECISION, RECALL, _, _, CHANCE, LARGEST, KIND_NAMED = ATTRIBUTION

PLUGIN = '''
import os
import numpy as np
from oodd_eval import DetectorSpec, Explanation, hookimpl


class Silent:
    """Largest change of a sensor, in its usual spread."""
    def __init__(self, *, seed=0, horizon=1): pass
    def fit(self, nominal):
        changes = [np.diff(x.observations, axis=0) for x in nominal]
        self.std = np.concatenate(changes).std(axis=0) + 1e-6
    def changes(self, x):
        before = np.concatenate([x.observations[:1], x.observations[:-1]])
        return abs(x.observations - before).astype(float) / self.std
    def score(self, x):
        scores = self.changes(x).max(axis=1)
        scores[:1] = np.nan
        return scores


class Tells(Silent):
    """Names the sensor that changed most; the onset is the row, or the largest change so far."""
    def explain(self, x):
        if "EXPLAIN_LOG" in os.environ:
            with open(os.environ["EXPLAIN_LOG"], "a") as log:
                print(os.getpid(), len(x), file=log)
        changes = self.changes(x) + 1e-9
        shares = changes / changes.sum(axis=1, keepdims=True)
        shares[:1] = np.nan
        onsets = np.arange(len(x))
        onsets[:1] = -1
        return Explanation(shares, onsets)


class Fails(Tells):
    def explain(self, x): raise RuntimeError("no idea")


class Overstates(Tells):
    def explain(self, x):
        shares, onsets, _ = super().explain(x)
        return 2 * shares, onsets


class Lasting(Tells):
    """Cannot be forked after its fit, and is restored for every group."""
    def fit(self, nominal):
        import threading, time
        super().fit(nominal)
        threading.Thread(target=time.sleep, args=(600,), daemon=True).start()
    def state(self): return {"std": self.std}
    def restore(self, state): self.std = state["std"]


@hookimpl
def oodd_detectors():
    own = Silent, Tells, Fails, Overstates, Lasting
    return [DetectorSpec(c.__name__.lower(), c, "a test's", deterministic=True) for c in own]
'''


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A plug-in of detectors that explain, and results of some of them in one directory."""
    home = tmp_path_factory.mktemp("explained")
    with pytest.MonkeyPatch.context() as patch:
        install(patch, home / "plugin", "explained", PLUGIN, header="")
        patch.setenv("PYTHONPATH", str(home / "plugin"))
        patch.setenv("EXPLAIN_LOG", str(home / "log"))
        found = {
            name: evaluate(name, environments="cartpole", anomalies="iid,drift,gravity",
                           output=home / "results")
            for name in ("silent", "tells")
        }  # fmt: skip
        patch.delenv("EXPLAIN_LOG")
        yield home, found


# Metrics


def test_metrics_of_hand_made_explanations():
    rule = GuaranteedAlarm(None, 5.0)  # an alarm where the score is above 5
    quiet, loud = np.zeros(10), np.zeros(10)
    loud[6:] = 9.0
    undefined = np.where(np.arange(10) < 2, NAN, loud)
    explained = np.full((2, 10), -1, dtype=np.int32)
    explained[:, 6] = 3, 2
    other = explained.copy()
    other[:, 6] = 0, 6
    found = attribution_contributions(
        [loud, loud, quiet, loud, undefined, loud],
        [explained, other, explained, explained, other, explained],
        [[1, 3], [1, 3], [3], [3], (), [3]],
        [4, 6, 4, 7, 5, 6],
        rule,
    )
    named, error = found["sensor_named"], found["onset_error"]
    # Without an alarm or with an early one (e = 7) nothing is defined; no sensor in the fifth one.
    assert named.denominator.tolist() == [1, 1, 0, 0, 0, 1]
    assert named.numerator.tolist() == [1, 0, 0, 0, 0, 1]
    assert named.value == pytest.approx(2 / 3)
    assert error.denominator.tolist() == [1, 1, 0, 0, 1, 1]
    assert error.numerator.tolist() == [2, 0, 0, 0, 1, 4]
    assert (error.value, error.n) == (1.5, 4)
    found = attribution_contributions([quiet], [explained], [[0]], [1], rule)
    assert all(np.isnan(c.value) and c.n == 0 for c in found.values())


def test_metrics_of_hand_made_namings():
    """Three sensors and two actuators; the last two episodes have no true part and no alarm."""
    alarm = [[1, 1, 1, 0, 0, 0], [2, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0], [4, 1, 0, 0, 0, 0],
             [1, 1, 0, 0, 0, 0]]  # fmt: skip
    later = [[1, 1, 0, 0, 0, 0], [2, 0, 0, 0, 1, 1], [1, 0, 0, 1, 0, 0], [4] + [0] * 5, [-1] * 6]
    largest = [[0, 0, 1, 1, 0, 0], [0, 1, 0, 0, 0, 0], [0] * 6, [0] * 6, [0] * 6]
    namings = np.array([alarm, later, largest], np.int8).swapaxes(0, 1)
    faulty = np.array(
        [[1, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 1, 0, 0], [0] * 5, [1, 0, 0, 0, 0]], bool
    )
    kinds, judged = [[1], [2], [1], [3, 4], [1]], np.array([1, 1, 1, 1, 0], bool)
    found = naming_contributions(namings, faulty, kinds, judged)
    assert [f"{name}_at_5pct" for name in found] == [*ATTRIBUTION[2:]]
    for name, right, total in (
        ("named_precision", [1, 1, 0, 0, 0], [2, 1, 0, 0, 0]),
        ("named_recall", [1, 1, 0, 0, 0], [2, 1, 1, 0, 0]),
        ("named_precision_20", [1, 1, 1, 0, 0], [1, 2, 1, 0, 0]),
        ("named_recall_20", [1, 1, 1, 0, 0], [2, 1, 1, 0, 0]),
        ("named_chance", [2 * 2 / 5, 1 / 5, 0, 0, 0], [2, 1, 0, 0, 0]),
        ("named_largest", [1, 0, 0, 0, 0], [2, 1, 1, 0, 0]),
        ("kind_named", [1, 1, 0, 1, 0], [1, 1, 1, 1, 0]),
    ):
        assert found[name].numerator.tolist() == right, name
        assert found[name].denominator.tolist() == total, name
        assert found[name].numerator.dtype == found[name].denominator.dtype == np.float64
    namings[:, 0, 0] = -1  # of a detector that names no kinds
    assert np.isnan(naming_contributions(namings, faulty, kinds, judged)["kind_named"].value)


@pytest.mark.parametrize("values", [[5.0], [1.0, 2.0, NAN, 8.0, 3.0], [4.0, NAN, 4.0, 0.0], [NAN]])
def test_medians_of_resamples_are_those_of_what_was_drawn(values):
    weights = bootstrap_weights(len(values), resamples=200)
    found = resampled(mean_of(values, median=True), weights)
    for median, counts in zip(found, weights.astype(int), strict=True):
        drawn = np.repeat(values, counts)
        drawn = drawn[~np.isnan(drawn)]
        assert np.array_equal(median, np.median(drawn) if drawn.size else NAN, equal_nan=True)


# What is kept, and checked


class Two:
    """Explains two sensors; the second one is due at even rows."""

    def fit(self, nominal): ...

    def score(self, x):
        return np.zeros(len(x))

    def explain(self, x):
        second = np.arange(len(x)) % 2 == 0
        return Explanation(np.stack([~second, second], axis=1) / 1.0, np.arange(len(x)) // 2)


def test_the_sensor_with_the_largest_share_is_kept():
    (found,) = explain_chunk(Two(), [Trajectory(np.zeros((4, 2)), np.zeros((3, 1)))])
    assert found.dtype == np.int32
    assert found.tolist() == [0, 1, -1, 1, 0, 0]  # row 3 is the first sensor's
    two = Two()
    naming = Naming(np.array([0.4, 0.5]), np.array([0.9]), np.zeros(2), "body")
    two.explain = lambda x: Two.explain(two, x)._replace(naming=naming)
    (found,) = explain_chunk(two, [Trajectory(np.zeros((4, 2)), np.zeros((3, 1)))])
    assert found.tolist() == [0, 1, 3, 0, 1, 1]
    assert explains(Two())
    assert not explains(GuaranteedAlarm(None, 1.0))


WHOLE = np.array([[-1, *[0] * 39], [-1, *[1] * 39]], dtype=np.int32)
SCORES = np.array([NAN, *[0.0] * 39])


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (np.array([1, 3, 0, 0, 1, 1]), "no explanation came back"),
        (np.array([1, 3], np.int32), "no explanation came back"),
        (np.array([1, 3, 0, 0, 1], np.int32), "no explanation came back"),
        ("WHOLE", "no explanation came back"),
        (np.array([1, 3, 5, 0, 1, 1], np.int32), "no naming came back"),
        (np.array([1, 3, -2, 0, 1, 1], np.int32), "no naming came back"),
        (np.array([1, 3, 0, 0, 2, 1], np.int32), "no naming came back"),
        (np.array([2, 1, 0, 0, 1, 1], np.int32), "names sensor 2 and onset 1 at t = 3"),
        (np.array([0, 4, 0, 0, 1, 1], np.int32), "names sensor 0 and onset 4 at t = 3"),
        (np.array([0, -1, 0, 0, 1, 1], np.int32), "names sensor 0 and onset -1 at t = 3"),
    ],
)
def test_what_cannot_be_an_explanation_is_refused(found, message):
    with pytest.raises(ContractError, match=message):
        check_named(found, Trajectory(np.zeros((4, 2)), np.zeros((3, 1))), "hopper/test/iid[0]")


# Storage


def test_explanations_are_stored_beside_scores_and_read_back(tmp_path):
    results = ResultsDirectory(tmp_path)
    results.prepare()
    scores, named = [SCORES, SCORES[:5]], [WHOLE, WHOLE[:, :5]]
    nominal = {CALIBRATION: scores, TWINS: scores}
    namings = {"test/iid": np.arange(2 * 3 * 4).reshape(2, 3, 4).astype(np.int8)}
    parts = {**nominal, "test/iid": scores}
    results.write_scores("a", ScoreFile(parts, {}, {"test/iid": named}, namings=namings))
    # A later run adds a part, without explanations as of an earlier version.
    results.write_scores("a", ScoreFile({**nominal, "test/drift": scores}, {}))
    lengths = {part: [40, 5] for part in (*nominal, "test/iid", "test/drift")}
    found = results.scores("a", lengths)
    assert list(found.explained) == ["test/iid"]
    for one, other in zip(found.explained["test/iid"], named, strict=True):
        assert one.dtype == np.int32
        assert np.array_equal(one, other)
    assert list(found.namings) == ["test/iid"]
    assert found.namings["test/iid"].dtype == np.int8
    assert np.array_equal(found.namings["test/iid"], namings["test/iid"])
    with h5py.File(tmp_path / "scores/a.h5") as file:
        assert {*file["test/iid"]} == {"scores", "offsets", "sensors", "onsets", "namings"}
        assert {*file["test/drift"]} == {*file[TWINS]} == {"scores", "offsets"}
    with h5py.File(tmp_path / "scores/a.h5", "r+") as file:
        for name in ("sensors", "onsets"):
            del file["test/iid"][name]
            file["test/iid"][name] = np.zeros(44, dtype=np.int32)
    assert results.scores("a", lengths) is None


@pytest.mark.parametrize("namings", [np.zeros((1, 3, 4), np.int8), np.zeros((2, 3, 4))])
def test_namings_of_another_form_are_not_read(tmp_path, namings):
    results = ResultsDirectory(tmp_path)
    results.prepare()
    parts = {"test/iid": [SCORES, SCORES[:5]]}
    results.write_scores("a", ScoreFile(parts, {}, namings={"test/iid": namings}))
    assert results.scores("a", {"test/iid": [40, 5]}) is None


# A run


def test_records_have_the_metrics_of_detectors_that_explain_only(world):
    _, found = world
    for record in found["silent"]:
        assert record.ok
        assert not {*ATTRIBUTION} & (record.metrics.keys() | record.per_trajectory.keys())
    for record in found["tells"]:
        assert record.ok, record.reason
        named, error = (record.metrics[name] for name in ATTRIBUTION[:2])
        delays = record.per_trajectory["delay_at_5pct"]
        # It names the row of the alarm, so that its error is the delay.
        assert np.array_equal(record.per_trajectory[ONSET_ERROR], delays)
        assert error.n == sum(delays[1])
        if error.n:
            defined = [d for d, known in zip(*delays, strict=True) if known]
            assert error.value == np.median(defined)
            assert error.low <= error.value <= error.high
        assert named.n == (error.n if record.group == "sensor" else 0)
    iid = next(r for r in found["tells"] if r.anomaly == "iid")
    assert iid.metrics[SENSOR_NAMED].value > 0.5
    precision, recall, chance, largest = (
        iid.metrics[name] for name in (PRECISION, RECALL, CHANCE, LARGEST)
    )
    assert 0 < chance.value < precision.value <= 1
    assert 0 < recall.value <= 1
    assert 0 <= largest.value <= 1
    assert recall.low <= recall.value <= recall.high
    assert np.isnan(iid.value(KIND_NAMED))  # it names no kinds
    gravity = next(r for r in found["tells"] if r.anomaly == "gravity")
    assert all(np.isnan(gravity.value(name)) for name in ATTRIBUTION[2:])


def test_anomalous_episodes_are_explained_up_to_their_alarms_each_group_in_a_process(world):
    home, found = world
    calls = [tuple(map(int, line.split())) for line in (home / "log").read_text().splitlines()]
    with load_split("mini").opened() as opened:
        file = stored_scores(found["tells"], ResultsDirectory(home / "results"), opened("cartpole"))
    rule = GuaranteedAlarm.fit(file.parts[CALIBRATION], 0.05, found["tells"][0].alarm)
    firsts = {
        part: [rule.first(scores) for scores in sequences]
        for part, sequences in file.parts.items()
        if part not in (CALIBRATION, TWINS)
    }
    alarms = [first for rows in firsts.values() for first in rows if first is not None]
    prefixes = [
        min(first + n, len(scores))
        for part, rows in firsts.items()
        for first, scores in zip(rows, file.parts[part], strict=True)
        if first is not None
        for n in (1, 21)
    ]
    assert sorted(n for _, n in calls) == sorted(prefixes)
    assert len(prefixes) == 2 * len(alarms)
    assert len({pid for pid, _ in calls}) == sum(
        rows != [None] * len(rows) for rows in firsts.values()
    )
    assert {*file.explained} == {*file.namings} == {*firsts}
    for part, rows in firsts.items():
        for first, scores, named in zip(rows, file.parts[part], file.explained[part], strict=True):
            assert named.shape == (2, len(scores))
            assert np.flatnonzero(named[1] >= 0).tolist() == ([] if first is None else [first])
        sensors = file.namings[part][:, :, 1:5]
        assert file.namings[part].shape == (len(rows), 3, 1 + 4 + 2)
        assert (sensors.sum(axis=2) > 0).tolist() == [[first is not None] * 3 for first in rows]
        assert (sensors[:, 0].sum(axis=1) == sensors[:, 2].sum(axis=1)).all()


@pytest.mark.parametrize(
    ("datasets", "lacking"),
    [(("sensors", "onsets", "namings"), ATTRIBUTION), (("namings",), ATTRIBUTION[2:])],
)
def test_scores_of_a_file_without_explanations_are_scored_as_ever(
    world, tmp_path, datasets, lacking
):
    home, found = world
    key = found["tells"][0].scores
    (tmp_path / "scores").mkdir()
    content = (home / "results/scores" / f"{key}.h5").read_bytes()
    (tmp_path / "scores" / f"{key}.h5").write_bytes(content)
    with h5py.File(tmp_path / "scores" / f"{key}.h5", "r+") as file:
        for anomaly in ("iid", "drift", "gravity"):
            for dataset in datasets:
                del file[f"test/{anomaly}/{dataset}"]
    for old, new in zip(
        found["tells"], rescore(found["tells"], ResultsDirectory(tmp_path), load_split("mini")),
        strict=True,
    ):  # fmt: skip
        assert new.ok
        assert old.metrics.keys() - new.metrics == {*lacking}
        assert all(str(old.metrics[name]) == str(new.metrics[name]) for name in new.metrics)


def test_a_detector_of_this_process_and_one_that_cannot_be_forked_explain_too(world):
    _, found = world
    import oodd_explained

    iid = next(r for r in found["tells"] if r.anomaly == "iid")
    for detector in (oodd_explained.Tells, "lasting"):
        (record,) = evaluate(detector, environments="cartpole", anomalies="iid")
        assert record.ok, record.reason
        assert str(record.metrics) == str(iid.metrics)


FAILURES = {
    "fails": ("error", "RuntimeError: no idea"),
    "overstates": ("invalid", "explain gives the shares"),
}


@pytest.mark.usefixtures("world")
def test_a_failing_explanation_is_a_state_with_a_reason():
    records = evaluate([*FAILURES], environments="cartpole", anomalies="iid")
    assert [record.detector for record in records] == [*FAILURES]
    for record in records:
        status, reason = FAILURES[record.detector]
        assert record.status == status, record.reason
        assert reason in record.reason
        assert not record.metrics


def test_tables_have_a_section_for_detectors_that_explain(world, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
    home, _ = world
    show = ["show", str(home / "results"), "--stored"]
    assert main([*show, "--wide"]) == 0
    shown = capsys.readouterr().out
    section = shown[shown.index("Attribution at 5 %") :].split("\n\n")[0]
    assert "sensor named" in section
    assert ("tells" in section, "silent" in section) == (True, False)
    assert main([*show, "--detector", "tells", "--metric", ONSET_ERROR, "--intervals"]) == 0
    assert "Onset error at 5 % by anomaly" in capsys.readouterr().out
