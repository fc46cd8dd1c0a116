"""Recorded columns beside the sensors, and failed episodes: who sees them, and what is judged."""

import json
import re
import threading
import zlib
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from helpers_columns import (
    SCORES,
    SENSORS,
    Sizes,
    scored_parts,
    sensors_alone,
    write_columns,
    write_columns_split,
)
from helpers_logs import UNPAIRED, write_log_manifest
from helpers_plugins import install

from oodd_eval import DetectorSpec, evaluate, load_split
from oodd_eval.cli.main import main
from oodd_eval.data.description import describe
from oodd_eval.errors import MissingExtraError, PromiseWarning, UnknownNameError, UsageError
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.tables import unpromised
from oodd_eval.scoring.doubts import doubts_after, doubts_before
from oodd_eval.scoring.executors import Executor, RunSettings
from oodd_eval.scoring.plan import make_plan, make_unit
from oodd_eval.scoring.runner import run
from oodd_eval.scoring.unit import UnitJob

NAMES = [column.name for column in (*SENSORS, *SCORES)]


@pytest.fixture(scope="module")
def parts():
    return scored_parts()


@pytest.fixture(scope="module")
def scored(tmp_path_factory, parts):
    return load_split(write_columns_split(tmp_path_factory.mktemp("scored") / "s", parts))


@pytest.fixture(scope="module")
def plain(tmp_path_factory, parts):
    """The same episodes without scores and without failures."""
    episodes = {**sensors_alone(parts), "failures": []}
    return load_split(write_columns_split(tmp_path_factory.mktemp("plain") / "p", episodes))


def rows_of(episode, *columns):
    """Columns of an episode as float32, as splits have them."""
    return episode.observations[:, [NAMES.index(name) for name in columns]].astype(np.float32)


# The view


def test_sensors_leave_out_scores_and_columns_have_all(scored, parts):
    with closing(scored.environment("arm")) as data:
        assert [q.name for q in data.sensors] == ["q0", "q1", "q2"]
        assert [q.name for q in data.columns] == NAMES == list(scored.columns)
        sets = {"train": data.train, "failures": data.failures, "calibration": data.calibration,
                "test/nominal": data.twins, "test/slip": data.labelled("slip")}  # fmt: skip
        for part, episodes in sets.items():
            for episode, recorded in zip(episodes, parts[part], strict=True):
                assert episode.observations.tobytes() == rows_of(recorded, *NAMES[:3]).tobytes()
        assert (
            data.train[2].observations.tobytes() == rows_of(parts["train"][2], *NAMES[:3]).tobytes()
        )
        assert data.labelled("slip").intervals == [((30, 45),)] * 5
        assert data.arrays("train")["observations"].shape[1] == len(NAMES)
        assert data.train[0].transitions == len(data.train[0].actions)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["vel_innov"], ["vel_innov"]),
        (["q1"], ["q1"]),
        (["pos_innov"], ["pos_innov[0]", "pos_innov[1]"]),
        (["pos_innov[1]"], ["pos_innov[1]"]),
        (["chunk_mse", "q0"], ["chunk_mse", "q0"]),
    ],
)
def test_a_view_shows_the_columns_that_are_named_in_their_order(scored, parts, names, expected):
    with closing(scored.environment("arm")) as data:
        shown = data.of_columns(names)
        assert [q.name for q in shown.sensors] == expected
        assert [q.name for q in data.sensors] == NAMES[:3]  # which is as it was
        for episode, recorded in zip(shown.labelled("slip"), parts["test/slip"], strict=True):
            assert episode.observations.tobytes() == rows_of(recorded, *expected).tobytes()
        again = shown.of_columns(["q2"])
        assert again.failures[1].observations.tobytes() == rows_of(
            parts["failures"][1], "q2").tobytes()  # fmt: skip
        assert again.digest == data.digest


def test_a_column_of_a_name_comes_before_a_block_of_it(tmp_path, parts):
    names = ["q0", "q0[0]", "q0[1]"]
    columns = [*(replace(q, name=n) for q, n in zip(SENSORS, names, strict=True)), *SCORES]
    split = load_split(write_columns_split(tmp_path / "s", parts, columns=columns))
    with closing(split.environment("arm")) as data:
        assert [q.name for q in data.of_columns(["q0"]).sensors] == ["q0"]
    assert evaluate("column:q0", split)[0].ok


def test_a_column_that_is_not_there_is_named_beside_the_nearest(scored):
    with closing(scored.environment("arm")) as data:
        with pytest.raises(
            UnknownNameError, match=r"unknown column of arm 'vel_inov': did you.*'vel_innov'"
        ):
            data.of_columns(["vel_inov"])
        with pytest.raises(UnknownNameError, match="chunk_ms"):
            data.of_columns(["chunk_ms"])


def test_offsets_of_a_view_are_those_of_its_columns(tmp_path, parts):
    facts = replace(UNPAIRED, offsets=(0.0, 5e6, 0.0, *[0.0] * len(SCORES)))
    split = load_split(write_columns_split(tmp_path / "s", parts, facts))
    with closing(split.environment("arm")) as data:
        assert data.logs.offsets == (0.0, 5e6, 0.0)
        assert data.of_columns(["chunk_mse", "q1"]).logs.offsets == (0.0, 5e6)
        assert data.of_columns(["q2", "q0", "q1"]).of_columns(["q1"]).logs.offsets == (5e6,)
    with pytest.raises(
        UsageError, match=r"column:q1: q1 of arm is stored less its mean.*among scores"
    ):
        evaluate("column:q1", split)
    assert evaluate("column:q0", split)[0].ok


def test_roles_for_detectors_are_those_of_the_sensors(tmp_path, parts, scored):
    assert scored.roles("arm") == ()
    columns = [replace(SENSORS[0], role="velocity"), *SENSORS[1:], *SCORES]
    split = load_split(write_columns_split(tmp_path / "s", parts, columns=columns))
    assert split.roles("arm") == ("velocity", "measured", "measured")
    with closing(split.environment("arm")) as data:
        assert [q.role for q in data.columns] == [
            "velocity",
            "measured",
            "measured",
            *["score"] * 5,
        ]


def test_what_is_said_of_a_split_tells_scores_from_sensors(scored, monkeypatch, capsys):
    text = describe(scored)
    assert re.search(r"^sensors: 0 q0 \[rad\], 1 q1 \[rad\], 2 q2 \[rad\]$", text, re.MULTILINE)
    assert re.search(
        r"^scores: 0 pos_innov\[0\], 1 pos_innov\[1\], 2 vel_innov, 3 alarm", text, re.MULTILINE
    )
    assert re.search(r"^failures +3 ", text, re.MULTILINE)
    monkeypatch.setenv("OODD_EVAL_DATA", str(scored.path.parent))
    assert main(["info", "arm"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^3 sensors +q0 \(rad\), q1 \(rad\), q2 \(rad\)$", out, re.MULTILINE)
    assert re.search(r"^5 scores +pos_innov\[0\] \(1\), pos_innov", out, re.MULTILINE)
    assert re.search(r"^failures +3 episodes$", out, re.MULTILINE)
    assert main(["list", "envs"]) == 0
    assert re.search(
        r"^arm .* 3 sensors, imported from logs$", capsys.readouterr().out, re.MULTILINE
    )


# Scores


def running_mean(column):
    total, means = 0.0, []
    for n, value in enumerate(column, 1):
        total += float(value)
        means.append(total / n)
    return np.array(means)


@pytest.mark.parametrize(
    ("name", "column", "change"),
    [
        ("column:chunk_mse", "chunk_mse", lambda x: x),
        ("column:-vel_innov", "vel_innov", lambda x: -x),
        ("column:|vel_innov|", "vel_innov", abs),
        ("column:pos_innov[1]", "pos_innov[1]", lambda x: x),
        ("column:q2", "q2", lambda x: x),
        ("mean:chunk_mse", "chunk_mse", running_mean),
        ("mean:abs(vel_innov)", "vel_innov", lambda x: running_mean(abs(x))),
        ("flag:alarm", "alarm", lambda x: (x > 0).astype(float)),
    ],
)
def test_scores_are_the_column_bit_for_bit(scored, parts, name, column, change, tmp_path):
    (record,) = evaluate(name, scored, output=tmp_path / "out")
    assert (record.status, record.detector) == ("ok", name.replace("|vel_innov|", "abs(vel_innov)"))
    lengths = {p: [len(e.observations) for e in es] for p, es in parts.items()}
    lengths = {part: lengths[part] for part in ("calibration", "test/nominal", "test/slip")}
    kept = ResultsDirectory(tmp_path / "out").scores(record.scores, lengths)
    for part in lengths:
        for scores, episode in zip(kept.parts[part], parts[part], strict=True):
            expected = change(rows_of(episode, column)[:, 0].astype(np.float64))
            assert scores.tobytes() == expected.tobytes()
    assert not kept.stream  # faults of the sensors do not join


def test_baseline_rows_count_for_nothing_and_bring_a_column_nowhere(tmp_path, parts):
    split = load_split(write_columns_split(tmp_path / "s", parts, replace(UNPAIRED, baseline=10)))
    results = evaluate(["column:q0", "mean:q0"], split, output=tmp_path / "out")
    lengths = {"calibration": [len(e.observations) for e in parts["calibration"]]}
    for record, change in zip(results, (lambda x: x, running_mean), strict=True):
        kept = ResultsDirectory(tmp_path / "out").scores(record.scores, lengths)
        for scores, episode in zip(kept.parts["calibration"], parts["calibration"], strict=True):
            assert np.isnan(scores[:10]).all()
            expected = change(rows_of(episode, "q0")[:, 0].astype(np.float64))[10:]
            assert scores[10:].tobytes() == expected.tobytes()


@pytest.mark.parametrize("baseline", [0, 10])
@pytest.mark.parametrize("how", ["rows", "this process"])
def test_scores_are_the_same_bits_row_by_row_and_in_this_process(tmp_path, parts, baseline, how):
    facts = replace(UNPAIRED, baseline=baseline, offsets=(0.0, 5e6, *[0.0] * 6))
    split = load_split(write_columns_split(tmp_path / "s", parts, facts))
    changes = {
        "column:-vel_innov": lambda e: -rows_of(e, "vel_innov")[:, 0].astype(float),
        "mean:abs(q2)": lambda e: running_mean(abs(rows_of(e, "q2")[:, 0])),
        "flag:alarm": lambda e: (rows_of(e, "alarm")[:, 0] != 0).astype(float),
    }
    results = ResultsDirectory(tmp_path / "out")
    if how == "rows":
        settings = RunSettings(jobs=1, limits=Limits(120), streamed=True)
        plan = _plan(split, *changes, limit=3)
        records = run(plan, split, discover(), settings, results).records
    else:
        specs = [discover().offer(name).spec for name in changes]
        records = evaluate(specs, split, limit=3, output=tmp_path / "out").records
    tests = ("calibration", "test/nominal", "test/slip")
    lengths = {part: [len(e.observations) for e in parts[part][:3]] for part in tests}
    for record, change in zip(records, changes.values(), strict=True):
        assert record.ok, record.reason
        kept = results.scores(record.scores, lengths)
        for part in lengths:
            for scores, episode in zip(kept.parts[part], parts[part], strict=False):
                expected = change(episode)
                expected[:baseline] = np.nan
                assert scores.tobytes() == expected.tobytes()


def test_other_detectors_score_as_without_scores_and_failures(scored, plain, parts, tmp_path):
    names = ["mahalanobis", "persistence", "clock", "mewma"]
    assert scored.train_digest("arm") != plain.train_digest("arm")
    lengths = {p: [len(e.observations) for e in parts[p]] for p in ("test/nominal", "test/slip")}
    runs = []
    for split in (scored, plain):
        results = evaluate(names, split, output=tmp_path / split.path.name)
        kept = ResultsDirectory(tmp_path / split.path.name)
        runs.append([(r, kept.scores(r.scores, lengths)) for r in results])
    for (one, ones), (other, others) in zip(*runs, strict=True):
        assert repr(one.metrics) == repr(other.metrics)
        assert one.counts == other.counts
        assert one.inputs == other.inputs
        for part in lengths:
            pairs = zip(ones.parts[part], others.parts[part], strict=True)
            assert all(a.tobytes() == b.tobytes() for a, b in pairs)


def test_doubts_are_those_of_the_sensors_and_none_for_flags(scored, plain):
    plans = [make_plan(discover(), split=s, detectors=["mahalanobis"], environments=["arm"])
             for s in (scored, plain)]  # fmt: skip
    found = [
        [*doubts_before(plan, split)] for plan, split in zip(plans, (scored, plain), strict=True)
    ]
    assert found[0] == found[1]
    flags = make_plan(discover(), split=scored, detectors=["flag:alarm"], environments=["arm"])
    assert not [*doubts_before(flags, scored)]


# Flags


def test_a_flag_is_judged_at_its_own_operating_point_and_promises_nothing(
    scored, parts, tmp_path, capsys
):
    directory = tmp_path / "out"
    with pytest.warns(PromiseWarning, match="column:alarm.* is 0 or 1, as an alarm is: flag:alarm"):
        results = evaluate(["flag:alarm", "column:alarm"], scored, output=directory)
    (flag, column) = results
    rings = [bool(rows_of(e, "alarm").any()) for e in parts["test/nominal"]]
    assert 0 < sum(rings) < len(rings)
    for suffix in ("at_10pct", "at_5pct"):
        assert flag.metrics[f"threshold_{suffix}"].value == 0.5
        assert flag.metrics[f"false_episodes_{suffix}"].value == np.mean(rings)
        assert flag.metrics[f"missed_{suffix}"].value == 0.0
        assert flag.metrics[f"delay_{suffix}"].value == 3  # the flag rings in rows 33 to 39
        assert "flag is an alarm already" in unpromised(flag, suffix)
        assert not unpromised(column, suffix)
    # One of five calibration episodes has a flag: as a score nothing is above its 1.
    assert column.metrics["threshold_at_5pct"].value == 1.0
    assert column.metrics["missed_at_5pct"].value == 1.0
    assert flag.calibration_draws == type(flag.calibration_draws)()
    plan = _plan(scored, "flag:alarm,column:alarm")
    ((environment, finding),) = doubts_after(plan, scored, ResultsDirectory(directory))
    assert environment == "arm"
    assert "is 0 or 1, as an alarm is: flag:alarm judges it as one" in finding.text
    capsys.readouterr()
    assert main(["show", str(directory), "--split", str(scored.path)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "\N{DOUBLE DAGGER}: a flag is an alarm already" in out
    assert "earlier versions" not in out
    assert (
        main(["show", str(directory), "--split", str(scored.path), "--alarm", "cusum", "--json"])
        == 0
    )
    shown = json.loads(capsys.readouterr().out)
    assert [r["threshold_at_5pct"] for r in shown] == [0.5, 1.0]
    assert [r["promise"].count("flag is an alarm") for r in shown] == [1, 0]


def test_a_flag_has_figures_at_every_level_with_few_calibration_episodes(tmp_path):
    parts = scored_parts(Sizes(calibration=2))
    split = load_split(write_columns_split(tmp_path / "s", parts))
    flag, column = evaluate(["flag:alarm", "column:vel_innov"], split)
    assert "false_episodes_at_5pct" in flag.metrics
    assert "false_episodes_at_10pct" not in column.metrics


# Names


def _plan(split, *names, plugins=None, **more):
    plugins = plugins or discover()
    detectors = plugins.select(",".join(names), split.columns)
    return make_plan(
        plugins, split=split, detectors=detectors, environments=split.environments, **more
    )


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        ("column:*_innov*", ["column:pos_innov[0]", "column:pos_innov[1]", "column:vel_innov"]),
        ("column:pos_innov[*", ["column:pos_innov[0]", "column:pos_innov[1]"]),
        ("column:-vel_*", ["column:-vel_innov"]),
        ("column:|vel_*|", ["column:abs(vel_innov)"]),
        ("mean:-abs(vel_*)", ["mean:-abs(vel_innov)"]),
        ("flag:a*m, column:q?", ["flag:alarm", "column:q0", "column:q1", "column:q2"]),
        ("column:pos_innov[0],clock", ["column:pos_innov[0]", "clock"]),
    ],
)
def test_a_glob_behind_a_colon_stands_for_columns(scored, patterns, expected):
    assert discover().select(patterns, scored.columns) == expected


def test_a_glob_that_stands_for_nothing_is_refused(scored):
    with pytest.raises(UnknownNameError, match=r"unknown column for 'column:x\*' 'x\*'"):
        discover().select("column:x*", scored.columns)


@pytest.mark.parametrize(
    "text",
    [
        "column:pos_innov[0]",
        "column:x[0][12]",
        "forecast:a.b.C",
        "column:abs(x)",
        "column:-x[1]",
        "rf",
    ],
)
@pytest.mark.parametrize("more", [{}, {"h": 5}, {"h": 2, "scale": "[1,2]"}])
def test_a_setting_with_brackets_in_its_name_is_read_back(text, more):
    more = dict(more)
    setting = Setting.of(text, more.pop("h", 1), more)
    assert Setting.parse(str(setting)) == setting


@pytest.mark.parametrize("text", ["clock[0]", "rf[", "[h=1]", ""])
def test_other_brackets_are_no_setting(text):
    with pytest.raises(UsageError, match="is no setting"):
        Setting.parse(text)


def test_names_with_brackets_go_through_all_commands(scored, tmp_path, capsys):
    out, split = str(tmp_path / "out"), ["--split", str(scored.path)]
    command = ["run", *split, "--env", "all", "--output", out, "-q"]
    names = "column:*_innov*,column:|vel_innov|,flag:alarm,clock"
    assert main([*command, "--detector", names]) == 0
    files = sorted(p.name for p in (tmp_path / "out" / "scores").glob("*.h5"))
    assert len(files) == 6
    assert all(re.fullmatch(r"[a-z0-9_.-]+", name) for name in files)
    assert files[0].startswith("clock-arm-")
    assert "column-pos_innov-0-arm-" in " ".join(files)
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "out" / "scores").glob("*.h5")}
    assert main([*command, "--detector", names, "-k", "pos_innov[1]"]) == 0
    assert {p: p.stat().st_mtime_ns for p in stamps} == stamps  # they were taken from there
    capsys.readouterr()
    assert main(["compare", out, "column:pos_innov[0]", "column:abs(vel_innov)"]) == 0
    assert "column:pos_innov[0]" in capsys.readouterr().out
    for layout in ("markdown", "html", "csv", "json"):
        assert main(["show", out, *split, f"--{layout}"]) == 0
        text = capsys.readouterr().out
        assert re.search(r"column:pos\\?_innov\\?\[0\\?\]", text), layout
        assert "flag:alarm" in text
    assert (
        main(["show", out, *split, "--detector", "column:pos_innov[1]", "--metric", "auc_rows"])
        == 0
    )
    capsys.readouterr()
    assert main(["forget", out, "-k", "pos_innov[0]"]) == 0
    left = {r.detector for r in ResultsDirectory(out).records()}
    assert "column:pos_innov[0]" not in left
    assert len(left) == 5


def test_info_describes_a_column(capsys):
    assert main(["info", "column:-pos_innov[0]"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^looks at +pos_innov\[0\]$", out, re.MULTILINE)
    assert re.search(r"^alarm +the recorded number itself$", out, re.MULTILINE)
    assert main(["info", "flag:alarm"]) == 0
    assert "promises nothing" in capsys.readouterr().out
    with pytest.raises(UsageError, match="names no column"):
        discover().offer("column:a,b")


# What an environment lacks


def test_a_column_that_an_environment_lacks_is_left_out_with_a_note(tmp_path, parts):
    directory = tmp_path / "two"
    entries = {
        "arm": write_columns(directory, parts),
        "leg": write_columns(
            directory, {**sensors_alone(parts), "failures": []}, environment="leg"
        ),
    }
    split = load_split(write_log_manifest(directory, entries, name="two"))
    assert split.columns == tuple(NAMES)
    plan = _plan(split, "column:vel_innov", "column:q0")
    assert [(u.environment, u.setting.detector) for u in plan.units] == [
        ("arm", "column:vel_innov"), ("arm", "column:q0"), ("leg", "column:q0")
    ]  # fmt: skip
    (note,) = plan.notes
    assert note.startswith("column:vel_innov is left out: unknown column of leg 'vel_innov'")
    with pytest.raises(
        UsageError, match=r"column:vel_inov: unknown column of arm 'vel_inov': did you mean"
    ):
        _plan(split, "clock", "column:vel_inov")


def test_a_block_of_columns_is_no_score(scored):
    (record,) = evaluate("column:pos_innov", scored)
    assert record.status == "error"
    assert "got 2 columns, expected 1" in record.reason
    assert "name one" in record.reason


# Failures

PLUGIN = """
import zlib

class Fails(Good):
    def fit(self, nominal, progress=None, failures=None):
        if failures is None:
            raise ValueError("no failures came")
        if progress:
            progress(0.5)
        self.sums = [float(digest(part)) for part in (nominal, failures)]
    def score(self, x):
        scores = np.zeros(len(x))
        scores[:2] = self.sums
        return scores
    def reset(self): self.n = 0
    def update(self, observation, action=None):
        self.n += 1
        return self.sums[self.n - 1] if self.n < 3 else 0.0
    def state(self):
        return {"sums": np.array(self.sums)}
    def restore(self, state):
        self.sums = list(state["sums"])

class Block(Fails):
    def fit(self, nominal, failures=None):
        super().fit(nominal, None, failures)

class Refuses(Good):
    def fit(self, nominal):
        pass

def digest(episodes):
    value = 0
    for x in episodes:
        value = zlib.crc32(x.observations.tobytes() + x.actions.tobytes(), value)
    return value

@hookimpl
def oodd_detectors():
    learns = dict(summary="a test's", training="failures", alarm="score")
    return [
        DetectorSpec("fails", Fails, **learns),
        DetectorSpec("fails-too", Fails, fit_name="fails", **learns),
        DetectorSpec("refuses", Refuses, **learns),
        DetectorSpec("block", Block, columns=("pos_innov", "q1"), **learns),
        DetectorSpec("block-too", Block, columns=("q1",), fit_name="block", **learns),
        DetectorSpec("acts", Fails, inputs="observations+actions", **learns),
    ]
"""


@pytest.fixture
def failing(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "plugin", "failing", PLUGIN)


def digest(episodes, *columns, actions=False):
    """CRC-32 of what a detector is to be handed."""
    value = 0
    for episode in episodes:
        rows = np.ascontiguousarray(rows_of(episode, *columns)).tobytes()
        zeros = np.zeros(len(episode.observations) - 1, np.float32).tobytes() if actions else b""
        value = zlib.crc32(rows + zeros, value)
    return float(value)


@pytest.mark.parametrize(
    ("name", "columns", "actions"),
    [
        ("fails", ("q0", "q1", "q2"), False),
        ("acts", ("q0", "q1", "q2"), True),
        ("block", ("pos_innov[0]", "pos_innov[1]", "q1"), False),
    ],
)
@pytest.mark.parametrize("how", ["batches", "rows", "a second run"])
def test_failures_are_handed_over_exactly(
    failing, scored, parts, tmp_path, name, columns, actions, how
):
    limit = 2 if how == "rows" else None
    results = ResultsDirectory(tmp_path / "out")
    plan, plugins = _plan(scored, name, limit=limit), discover()
    settings = RunSettings(jobs=1, limits=Limits(120), streamed=how == "rows")
    (record,) = run(plan, scored, plugins, settings, results).records
    if how == "a second run":  # which takes over the state of the fit
        for file in (tmp_path / "out" / "scores").iterdir():
            file.unlink()
        results = ResultsDirectory(tmp_path / "out")
        (record,) = run(plan, scored, plugins, settings, results).records
    assert record.ok, record.reason
    lengths = {"calibration": [len(e.observations) for e in parts["calibration"]][:limit]}
    kept = results.scores(record.scores, lengths)
    expected = [digest(parts[p][:limit], *columns, actions=actions) for p in ("train", "failures")]
    for scores in kept.parts["calibration"]:
        assert scores[:2].tolist() == expected
        assert not scores[2:].any()


def test_a_fit_key_is_of_failures_and_columns(failing, scored, parts, tmp_path):
    fewer = {**parts, "failures": parts["failures"][:2]}
    other = load_split(write_columns_split(tmp_path / "fewer", fewer))
    assert other.train_digest("arm") == scored.train_digest("arm")
    plugins = discover()

    def key(name, split):
        return make_unit(
            plugins.offer(name), {}, split, "arm", split.conditions("arm"), 1, 0, None
        ).fit_key

    assert key("fails", scored) != key("fails", other)
    assert key("mahalanobis", scored) == key("mahalanobis", other)
    assert key("fails", scored) == key("fails-too", scored)
    assert key("block", scored) != key("block-too", scored)


def test_without_failures_a_detector_that_learns_from_them_is_left_out(failing, plain, capsys):
    plan = _plan(plain, "fails", "clock")
    assert [u.setting.detector for u in plan.units] == ["clock"]
    assert plan.notes[0].startswith("fails is left out: arm has no failed episodes to learn from")
    assert "failures = 0.5" in plan.notes[0]
    with pytest.raises(UsageError, match="fails: arm has no failed episodes"):
        _plan(plain, "fails")


def test_a_fit_that_takes_no_failures_is_an_error(failing, scored):
    (record,) = evaluate("refuses", scored)
    assert record.status == "invalid"
    assert "its fit takes none: expected fit(nominal, failures=None)" in record.reason


class Counts:
    """Takes failures, and declares nothing."""

    def fit(self, nominal, failures=None):
        self.seen = None if failures is None else [len(x) for x in failures]

    def score(self, x):
        return np.full(len(x), -1.0 if self.seen is None else float(sum(self.seen)))


def test_in_this_process_failures_go_to_a_spec_that_declares_them(scored, parts, tmp_path):
    spec = DetectorSpec("counts", Counts, "a test's", training="failures", alarm="score")
    lengths = {"calibration": [len(e.observations) for e in parts["calibration"]]}
    expected = sum(len(e.observations) for e in parts["failures"])
    for detector, value in ((spec, expected), (Counts, -1), (Counts(), -1)):
        out = tmp_path / str(value) / type(detector).__name__
        (record,) = evaluate(detector, scored, output=out)
        kept = ResultsDirectory(out).scores(record.scores, lengths)
        assert {float(s) for scores in kept.parts["calibration"] for s in scores} == {value}
        assert record.training == ("failures" if detector is spec else "nominal")


@pytest.mark.parametrize("name", ["block", "column:pos_innov[1]"])
def test_on_another_machine_a_unit_gets_the_same_columns_and_failures(failing, scored, name):
    remote = pytest.importorskip("oodd_eval.scoring.executors.dask", exc_type=MissingExtraError)
    plan = _plan(scored, name)
    with closing(scored.environment("arm")) as data:
        job = UnitJob(plan, plan.units[0], data, discover().offer(name))
        order = json.loads(json.dumps(remote.order_of(job, scored, Limits())))
        there = remote.run_order(order, threading.Event().is_set)
        here = Executor(RunSettings(jobs=1), None, threading.Event())(job)
    remote._environment.cache_clear()
    assert there["status"] == here.status == "ok"
    for part, arrays in here.file.parts.items():
        assert [x.tolist() for x in there["parts"][part]] == [x.tolist() for x in arrays]
