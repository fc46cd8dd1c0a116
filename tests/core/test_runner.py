"""The runner: plan, isolation, resume, interruption; whatever a detector does, the others go on."""

import dataclasses
import json
import re
import textwrap
from functools import partial

import pytest
from helpers_plugins import install, local_spec
from oodd_trivial import Clock

from oodd_eval import evaluate, load_split
from oodd_eval.errors import ContractError, OutputError, ResultsError, SplitError, UsageError
from oodd_eval.names import expression, memory_bytes, seconds, select, whole_numbers
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.supervisor import Outcome, run_isolated
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import rescore
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan, source_digest
from oodd_eval.scoring.runner import run

HOSTILE = """
class PlainList(Good):
    def score(self, x): return super().score(x).tolist()

class Words(Good):
    def score(self, x): return ["calm"] * len(x)

class Huge(Good):
    def score(self, x): return super().score(x) * 0 + 1.7e308

class FewScores(Good):
    def score_many(self, xs): return [self.score(x) for x in xs][1:]

class BadWarmUp(Good):
    warm_up = 50

class RaisesInFit(Good):
    def fit(self, nominal): raise RuntimeError("no mood")

class Unsuited(Good):
    def fit(self, nominal): raise NotImplementedError("continuous actions only")

class Unequipped(Good):
    def fit(self, nominal): import no_such_module

class WithoutExtra(Good):
    def fit(self, nominal):
        from oodd_eval.errors import MissingExtraError
        raise MissingExtraError("needs torch: install oodd-eval[reference]")

def no_detector(**settings): return 42

@hookimpl
def oodd_detectors():
    found = {k: v for k, v in globals().items() if isinstance(v, type) and issubclass(v, Good)}
    unavailable = DetectorSpec("unavailable", Good, "", requires=("no_such",), extra="oodd-x[y]")
    return [*offer(no_detector=no_detector), unavailable,
            *(DetectorSpec(k.lower(), v, "") for k, v in found.items() if k != "Good")]
"""

STATES = {
    "plainlist": ("ok", ""),
    "words": ("invalid", "score returned list of <U4, expected real numbers in an array"),
    "huge": ("invalid", "too large"),
    "fewscores": ("invalid", r"score_many returned \d+ score arrays, expected \d+"),
    "badwarmup": ("invalid", "declares warm_up = 50, expected an int between 0 and 20"),
    "raisesinfit": ("error", r"RuntimeError: no mood \(oodd_hostile.py:\d+\)"),
    "unsuited": ("incompatible", "NotImplementedError: continuous actions only"),
    "unequipped": ("unavailable", "No module named 'no_such_module'"),
    "withoutextra": ("unavailable", r"needs torch: install oodd-eval\[reference\]"),
    "unavailable": ("unavailable", r'needs no_such: pip install "oodd-x\[y\]"'),
    "no-detector": ("invalid", "the factory returned int, expected an object with the methods"),
    "clock": ("ok", ""),
}

VOLATILE = {"seconds_fit", "seconds_score", "peak_rss_mb", "provenance"}


def stable(records):
    """Everything of records but cost and provenance, as bytes."""
    plain = [json.loads(record.to_json()) for record in records]
    return json.dumps([{k: v for k, v in p.items() if k not in VOLATILE} for p in plain])


def run_tiny(split, detectors=("clock",), output=None, *, environments=("cartpole",),
             anomalies=("iid",), plugins=None, limit=None, observer=None, **settings):  # fmt: skip
    opened = load_split(split)
    plugins = plugins or discover()
    plan = make_plan(
        plugins, split=opened, detectors=list(detectors),
        environments=list(environments), anomalies=list(anomalies), limit=limit,
    )  # fmt: skip
    results = ResultsDirectory(output) if output else None
    watching = [observer] if observer else []
    return run(plan, opened, plugins, RunSettings(**settings), results, watching)


@pytest.fixture(scope="module")
def hostile(tiny_split, tmp_path_factory):
    """Records of one run of all hostile detectors, and its output directory."""
    with pytest.MonkeyPatch.context() as patch:
        install(patch, tmp_path_factory.mktemp("plugin"), "hostile", HOSTILE)
        output = tmp_path_factory.mktemp("hostile")
        limits = Limits(seconds=120, memory=300_000_000)
        done = run_tiny(tiny_split, STATES, output, jobs=4, limits=limits)
    assert [record.detector for record in done.records] == list(STATES)
    return {record.detector: record for record in done.records}, output


@pytest.mark.parametrize("name", STATES)
def test_every_way_to_fail_is_a_state_with_a_reason(hostile, name):
    status, reason = STATES[name]
    records, output = hostile
    record = records[name]
    if name == "raisesinfit":
        log = (output / "logs" / f"{record.scores}.txt").read_text()
        assert all(text in log for text in ("Traceback", "no mood"))
    assert record.status == status, record.reason
    assert re.search(reason, record.reason)
    assert bool(record.reason) == (status != "ok")
    assert bool(record.metrics) == (status == "ok")


def test_results_do_not_depend_on_the_number_of_jobs(tiny_split, tmp_path):
    settings = {"environments": ("cartpole", "hopper"), "anomalies": ("iid", "gravity")}
    found = [
        run_tiny(tiny_split, ["persistence"], tmp_path / str(jobs), jobs=jobs, **settings)
        for jobs in (1, 2)
    ]
    assert stable(found[0].records) == stable(found[1].records)
    first, second = (ResultsDirectory(tmp_path / jobs).records() for jobs in "12")
    assert stable(first) == stable(second) == stable(found[0].records)


def test_in_process_and_worker_agree(tiny_split):
    cells = {"environments": "hopper", "anomalies": "iid,gravity"}
    one, two = (
        evaluate(d, tiny_split, **cells) for d in ("persistence", local_spec("persistence"))
    )
    assert [r.anomaly for r in one] == [r.anomaly for r in two] == ["iid", "gravity"]
    assert [r.metrics for r in one] == [r.metrics for r in two]


class Short(Clock):
    """Returns a score too few."""

    def score(self, trajectory):
        return super().score(trajectory)[1:]


class Unlucky(Clock):
    """Cannot be fitted on CartPole."""

    def fit(self, nominal):
        if nominal[0].observation_dim == 4:
            raise ValueError("no luck")


def test_evaluate_passes_on_what_a_sole_detector_raises(tiny_split):
    with pytest.raises(ContractError, match=r"'short' returned 60 scores for cartpole/calibration"):
        evaluate(Short, tiny_split)


def test_a_detector_that_raises_loses_no_row_of_several(tiny_split):
    tried = [Unlucky, local_spec("range"), Short]
    cells = {"environments": "cartpole,hopper", "anomalies": "iid"}
    rows = {(r.detector, r.environment): r for r in evaluate(tried, tiny_split, **cells)}
    statuses = {key: record.status for key, record in rows.items()}
    assert statuses == {
        ("unlucky", "cartpole"): "error", ("unlucky", "hopper"): "ok",
        ("range", "cartpole"): "ok", ("range", "hopper"): "ok",
        ("short", "cartpole"): "invalid", ("short", "hopper"): "invalid",
    }  # fmt: skip
    assert rows["unlucky", "cartpole"].reason == "ValueError: no luck"
    assert "'short' returned 60 scores" in rows["short", "cartpole"].reason
    alone = evaluate([local_spec("range")], tiny_split, **cells)
    assert stable(alone) == stable([rows["range", record.environment] for record in alone])


COUNTING = """
class Counting(Good):
    def fit(self, nominal):
        super().fit(nominal)
        with open(LOG, "a") as file: file.write(f"{{len(nominal)}}\\n")

@hookimpl
def oodd_detectors(): return offer(counting=Counting)
"""


@pytest.fixture
def counting(monkeypatch, tmp_path):
    """A plug-in that writes a line per fit: the module, and a function that reads the lines."""
    log = tmp_path / "fits"
    code = f"LOG = {str(log)!r}\n{COUNTING.format()}"
    module = install(monkeypatch, tmp_path / "plugin", "counting", code)
    return module, lambda: log.read_text().split() if log.exists() else []


def test_a_second_run_resumes_without_a_fit(tiny_split, tmp_path, counting):
    first = run_tiny(tiny_split, ["counting"], tmp_path / "out")
    second = run_tiny(tiny_split, ["counting"], tmp_path / "out")
    assert counting[1]() == ["6"]
    assert stable(first.records) == stable(second.records)


def test_another_anomaly_is_scored_and_the_earlier_scores_stay(tiny_split, tmp_path, counting):
    for anomaly in ("iid", "gravity", "iid"):
        run_tiny(tiny_split, ["counting"], tmp_path / "out", anomalies=[anomaly])
    assert len(counting[1]()) == 2


def test_changed_code_is_fitted_again(tiny_split, tmp_path, counting):
    module, fits = counting
    run_tiny(tiny_split, ["counting"], tmp_path / "out")
    module.write_text(module.read_text() + "\n# changed\n")
    source_digest.cache_clear()
    run_tiny(tiny_split, ["counting"], tmp_path / "out")
    assert len(fits()) == 2


def test_a_limited_run_does_not_pass_for_a_whole_one(tiny_split, tmp_path, counting):
    limited = run_tiny(tiny_split, ["counting"], tmp_path / "out", limit=2).records
    whole = run_tiny(tiny_split, ["counting"], tmp_path / "out").records
    assert counting[1]() == ["2", "6"]
    assert limited[0].counts == {"train": 2, "calibration": 2, "test": 2}
    assert whole[0].counts == {"train": 6, "calibration": 4, "test": 3}
    assert len(ResultsDirectory(tmp_path / "out").records()) == 2


def test_shared_code_of_a_plugin_counts_as_its_source(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "a", "user", "import oodd_helper\n")
    helper = install(monkeypatch, tmp_path / "b", "helper", "X = 1\n")
    before = source_digest.__wrapped__("oodd_user")
    helper.write_text("X = 2\n")
    assert source_digest.__wrapped__("oodd_user") != before


class Interrupting:
    @hookimpl
    def oodd_cell_finished(self, record):
        raise KeyboardInterrupt


def test_an_interrupted_run_keeps_what_was_finished(tiny_split, tmp_path, counting):
    done = run_tiny(
        tiny_split, ["counting", "clock"], tmp_path / "out", jobs=1, observer=Interrupting()
    )
    assert done.interrupted
    assert [r.detector for r in done.records] == ["counting"]
    assert [r.detector for r in ResultsDirectory(tmp_path / "out").records()] == ["counting"]
    run_tiny(tiny_split, ["counting", "clock"], tmp_path / "out")
    assert len(counting[1]()) == 1


def test_an_output_that_cannot_be_written_is_found_before_any_work(tiny_split, tmp_path, counting):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"cannot be written to.*--output"):
        run_tiny(tiny_split, ["counting"], tmp_path / "file" / "out")
    assert counting[1]() == []


def test_rescoring_gives_the_same_records_or_says_what_is_missing(tiny_split, tmp_path):
    split, results = load_split(tiny_split), ResultsDirectory(tmp_path / "out")
    records = run_tiny(tiny_split, ["persistence"], tmp_path / "out").records
    bare = [dataclasses.replace(r, metrics={}, per_trajectory={}) for r in records]
    assert stable(rescore(bare, results, split)) == stable(records)
    other = [dataclasses.replace(r, split_digest="0" * 64) for r in records]
    with pytest.raises(ResultsError, match="digest 000000000000, but split 'tiny' here has"):
        rescore(other, results, split)
    for file in (tmp_path / "out" / "scores").iterdir():
        file.unlink()
    with pytest.raises(ResultsError, match=r"scores/persistence-cartpole-\w+\.h5.*--stored"):
        rescore(records, results, split)


def test_an_error_of_reading_data_is_kept_for_the_caller():
    def broken():
        yield from ()
        raise OSError("disk gone")

    request = {"plugin": "trivial", "detector": "clock", "parameters": {}, "seed": 0, "horizon": 1}
    with pytest.raises(OSError, match="disk gone"):
        run_isolated(request, [], [broken()], limits=Limits(60), stop=lambda: False)


@pytest.mark.parametrize(("error", "ends"), [(SplitError("gone"), True), (KeyError("x"), False)])
def test_whatever_a_unit_raises_stays_in_it_but_for_what_the_user_can_mend(
    tiny_split, monkeypatch, error, ends
):
    def raising(request, *_, **__):
        if request["detector"] == "clock":
            raise error
        return Outcome("oom", "as ever")

    monkeypatch.setattr("oodd_eval.scoring.unit.run_isolated", raising)
    if ends:
        with pytest.raises(SplitError):
            run_tiny(tiny_split, ["clock", "random"])
        return
    found = {
        (r.detector, r.status, r.reason) for r in run_tiny(tiny_split, ["clock", "random"]).records
    }
    assert found == {("clock", "error", "oodd-eval: KeyError: 'x'"), ("random", "oom", "as ever")}


# Selection


@pytest.mark.parametrize(
    ("patterns", "names"),
    [
        ("b", ["b"]),
        ("c,a", ["c", "a"]),
        ("all", ["a", "b", "c", "ab"]),
        ("a*", ["a", "ab"]),
        ("b, *b", ["b", "ab"]),
        *((nothing, None) for nothing in ("", ",", "x", "x*", "a,x")),
    ],
)
def test_names_are_selected_in_the_order_asked_for(patterns, names):
    if names is None:
        with pytest.raises(UsageError):
            select("thing", patterns, ["a", "b", "c", "ab"])
        return
    assert select("thing", patterns, ["a", "b", "c", "ab"]) == names


@pytest.mark.parametrize(
    ("text", "cell", "wanted"),
    [
        ("iid", "mini/hopper/iid::rf[h=1,seed=0]", True),
        ("HOPPER", "mini/hopper/iid::rf[h=1,seed=0]", True),
        ("not iid", "mini/hopper/iid::rf[h=1,seed=0]", False),
        ("ant or hopper and not rf", "mini/hopper/iid::rf[h=1,seed=0]", False),
        ("(ant or hopper) and rf[h=1", "mini/hopper/iid::rf[h=1,seed=0]", True),
        ("ant or hopper and not rf", "mini/ant/iid::rf[h=1,seed=0]", True),
        ("not (ant or hopper)", "mini/ant/iid::rf[h=1,seed=0]", False),
        ("not not ant", "mini/ant/iid::rf[h=1,seed=0]", True),
        ("", "mini/ant/iid::rf[h=1,seed=0]", True),
        *((broken, "", None) for broken in (" ", "and", "a and", "a b", "(a", "a)", "not", "()")),
    ],
)
def test_expressions_select_cells(text, cell, wanted):
    if wanted is None:
        with pytest.raises(UsageError, match=r"-k .* cannot be read"):
            expression(text)
        return
    assert expression(text)(cell) is wanted


@pytest.mark.parametrize(
    ("read", "text", "number"),
    [
        (partial(whole_numbers, least=0), "0,3,3", [0, 3]),
        (partial(whole_numbers, least=1), "0", None),
        (partial(whole_numbers, least=0), "x", None),
        *((seconds, *pair) for pair in (("90", 90), ("1.5m", 90), ("2h", 7200))),
        *((seconds, text, None) for text in ("soon", "0")),
        (memory_bytes, "8GB", 8 * 10**9),
        (memory_bytes, "1 GiB", 2**30),
        (memory_bytes, "8 bananas", None),
    ],
)
def test_numbers_times_and_amounts(read, text, number):
    if number is None:
        with pytest.raises(UsageError, match=r"expected (whole numbers|a time|an amount)"):
            read(text)
        return
    assert read(text) == number


@pytest.fixture
def tuned(monkeypatch, tmp_path):
    code = """
    from dataclasses import dataclass
    from oodd_eval.plugins.parameters import parameter

    @dataclass(frozen=True)
    class Parameters:
        size: int = parameter(5)
        kind: str = parameter("a")
        draws: int = parameter(1, decides="scores")
        device: str = parameter("cpu", decides="nothing")

    @hookimpl
    def oodd_detectors():
        return [DetectorSpec("tuned", Good, "", parameters=Parameters, horizon_decides_fit=False)]
    """
    install(monkeypatch, tmp_path, "tuned", textwrap.dedent(code))
    return discover()


def tuned_unit(plugins, split="mini", **changes):
    asked = {"environments": ["ant"], "anomalies": ["iid"], "horizons": [10], "seeds": [3],
             "parameters": {"size": 7, "kind": "a"}, **changes}  # fmt: skip
    (unit,) = make_plan(plugins, split=load_split(split), detectors=["tuned"], **asked).units
    return unit


def test_cells_name_what_is_not_a_default(tuned):
    unit = tuned_unit(tuned)
    assert unit.setting.label(unit.seed) == "tuned[h=10,seed=3,size=7]"
    assert unit.parameters == {"device": "cpu", "draws": 1, "kind": "a", "size": 7}


@pytest.mark.parametrize(
    ("change", "scores", "fit"),
    [
        ({"split": "another"}, True, True),
        ({"seeds": [4]}, True, True),
        ({"environments": ["hopper"]}, True, True),
        ({"limit": 3}, True, True),
        ({"parameters": {"size": 8}}, True, True),
        ({"parameters": {"size": 7, "draws": 2}}, True, False),
        ({"horizons": [1]}, True, False),
        ({"anomalies": ["drift"]}, False, False),
        ({"parameters": {"kind": "a", "size": 7, "draws": 1}}, False, False),
        ({"device": "cuda"}, False, False),
    ],
)
def test_everything_that_decides_scores_or_the_fit_is_in_their_key(
    tuned, tiny_split, change, scores, fit
):
    if "split" in change:
        change = {"split": tiny_split, "environments": ["cartpole"]}
    before, after = tuned_unit(tuned), tuned_unit(tuned, **change)
    assert (before.scores_key != after.scores_key, before.fit_key != after.fit_key) == (scores, fit)


def test_the_device_reaches_the_detector_and_makes_no_row_of_its_own(tuned):
    unit = tuned_unit(tuned, device="cuda")
    assert unit.parameters["device"] == "cuda"
    assert unit.setting == tuned_unit(tuned).setting
    assert "device" not in unit.recorded
    with pytest.raises(UsageError, match="none of the detectors has a device"):
        make_plan(tuned, split=load_split("mini"), detectors=["clock"], environments=["ant"],
                  device="cuda")  # fmt: skip


def test_filtering_a_plan_drops_units_without_cells():
    plan = make_plan(
        discover(), split=load_split("mini"), detectors=["clock", "random"],
        environments=["ant", "hopper"],
    )  # fmt: skip
    assert len(plan.cells) == 2 * 2 * 8
    left = plan.matching(expression("clock and ant/ and wind"))
    assert list(map(str, left.cells)) == [
        "mini/ant/wind-l2r::clock[h=1,seed=0]",
        "mini/ant/wind-r2l::clock[h=1,seed=0]",
    ]
    assert plan.matching(expression("zzz")).units == ()
