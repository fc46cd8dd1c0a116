"""The pytest plug-in: off unless asked, one run of the harness, one test per cell."""

import os
from dataclasses import replace
from types import SimpleNamespace

import pytest
from helpers_plugins import install
from oodd_checks.pytest_cells import Cells, Regression

from oodd_eval import evaluate
from oodd_eval.results.comparison import read_record_set, write_reference
from oodd_eval.results.record import Metric

pytest_plugins = ["pytester"]

OPTIONS = {
    "oodd_detector": "persistence", "oodd_reference": None, "oodd_split": "tiny", "oodd_env": None,
    "oodd_fail": [], "oodd_two_sided": False, "oodd_output": None,
}  # fmt: skip


@pytest.fixture(scope="module")
def reference(tiny_split, tmp_path_factory):
    """Reference of persistence on the tiny split."""
    path = tmp_path_factory.mktemp("reference") / "reference.jsonl"
    write_reference(evaluate("persistence", tiny_split), path)
    return path


@pytest.fixture
def run(pytester, tiny_split, monkeypatch):
    """Run pytest in a process of its own, with warnings as errors."""
    monkeypatch.setenv("OODD_EVAL_DATA", str(tiny_split.parent))

    def call(*arguments):
        always = ["-W", "error", "--strict-markers", "-p", "no:cacheprovider"]
        return pytester.runpytest_subprocess(*always, *map(str, arguments), timeout=120)

    return call


@pytest.fixture
def cells(tiny_split, monkeypatch):
    """Prepare a check in this process."""
    monkeypatch.setenv("OODD_EVAL_DATA", str(tiny_split.parent))
    return lambda **options: Cells(SimpleNamespace(getoption=(OPTIONS | options).get))


def altered(reference, path, **figures):
    """Write the reference with other figures of hopper/iid."""
    cell = "tiny/hopper/iid::persistence[h=1,seed=0]"
    changed = {name: Metric(value) for name, value in figures.items()}
    records = [
        replace(r, metrics=r.metrics | changed) if str(r.cell) == cell else r
        for r in read_record_set(reference).records
    ]
    write_reference(records, path)
    return path


def test_rows_are_those_of_the_reference(cells, tiny_split, tmp_path):
    records = evaluate("persistence", tiny_split, environments="hopper")
    for row in ("panel", "panel-a"):
        write_reference([replace(record, detector=row) for record in records], tmp_path / row)
        plan = cells(oodd_detector="panel", oodd_reference=tmp_path / row).plan
        assert [u.setting.detector for u in plan.units] == [row]
    assert [u.setting.detector for u in cells(oodd_detector="panel").plan.units] == ["panel-a"] * 2


def test_off_unless_asked_and_nothing_of_the_harness_is_imported(run, pytester):
    pytester.makepyfile(
        "import sys\n"
        "def test_imports():\n"
        "    loaded = {m for m in sys.modules if m.startswith('oodd_')}\n"
        "    assert loaded == {'oodd_checks', 'oodd_checks.pytest_plugin'}\n"
        "    assert not {'numpy', 'h5py', 'pluggy.x', 'rich.table'} & set(sys.modules)\n"
    )
    # hypothesis' plug-in and pytest-benchmark's may import what they like.
    result = run("-p", "no:hypothesispytest", "-p", "no:benchmark")
    result.assert_outcomes(passed=1)
    assert "oodd-eval::" not in result.stdout.str()
    assert not result.stderr.str()
    result = run("--oodd-reference", os.devnull)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: --oodd-reference needs --oodd-detector, the name of *"])


def test_equal_figures_pass_beside_the_repositorys_own_tests(run, pytester, reference):
    pytester.makepyfile("def test_own(): pass")
    result = run(
        "--oodd-detector", "persistence", "--oodd-reference", reference, "--oodd-split", "tiny",
        "--oodd-output", "out", "-k", "own or not gravity",
    )  # fmt: skip
    result.assert_outcomes(passed=15, deselected=2)
    result.stdout.fnmatch_lines(
        [
            f"oodd-eval: 16 cells in 2 fits, against {reference}",
            "collected 17 items / 2 deselected / 15 selected",
        ]
    )
    # One run of the harness, without the cells that were not chosen.
    assert len((pytester.path / "out" / "records.jsonl").read_text().splitlines()) == 14


def test_a_regression_is_a_failure_with_a_readable_message(run, pytester, reference):
    worse = altered(reference, pytester.path / "worse.jsonl", auc=1.5, far=1.0)
    result = run(
        "--oodd-detector", "persistence", "--oodd-reference", worse, "--oodd-split", "tiny",
        "--oodd-env", "hopper", "--oodd-fail", "auc:-0.01", "--oodd-fail", "far:0",
        "--junitxml", "cells.xml",
    )  # fmt: skip
    result.assert_outcomes(failed=1, passed=7)
    result.stdout.re_match_lines(
        [
            r"_+ tiny/hopper/iid::persistence\[h=1,seed=0\] _+",
            r"auc worse: reference 1\.5, now 0\.\d+, ↓ 1\.\d+, tolerance -0\.01",
            "the reference is .*worse.jsonl; to run this cell alone:",
            "oodd-eval run --detector persistence --env hopper --anomaly iid --split tiny .*",
        ],
        consecutive=True,
    )
    assert result.ret == 1
    assert "Traceback" not in result.stdout.str()
    assert 'failures="1"' in (pytester.path / "cells.xml").read_text()


def test_an_improvement_fails_only_when_both_sides_count(cells, pytester, reference):
    better = altered(reference, pytester.path / "better.jsonl", far=1.0)
    for two_sided in (False, True):
        own = cells(oodd_reference=str(better), oodd_env="hopper", oodd_two_sided=two_sided)
        own.run(set(own.names))
        failing = {
            d.tolerance.metric for found in own._differences.values() for d in found if d.fails
        }
        assert failing == ({"far"} if two_sided else set())


FAILING = """
class Fails(Good):
    def score(self, x): raise RuntimeError("no mood")

@hookimpl
def oodd_detectors():
    return offer(fails=Fails)
"""


def test_a_detector_that_fails_is_reported_with_its_state(cells, monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "fails", FAILING)
    own = cells(oodd_detector="fails", oodd_env="hopper")
    own.run(set(own.names))
    for cell in own.names:
        with pytest.raises(
            Regression, match=r"^error: RuntimeError: no mood \(oodd_fails.py:\d+\)"
        ):
            own.check(cell, None)


def test_a_new_cell_is_skipped(cells, reference, tmp_path):
    cell = "tiny/hopper/iid::persistence[h=1,seed=0]"
    less = [r for r in read_record_set(reference).records if str(r.cell) != cell]
    write_reference(less, tmp_path / "less.jsonl")
    own = cells(oodd_reference=str(tmp_path / "less.jsonl"), oodd_env="hopper")
    own.run(set(own.names))
    first, *others = own.names
    with pytest.raises(pytest.skip.Exception, match=r"not in .*less.jsonl: nothing"):
        own.check(first, None)
    for cell in others:
        own.check(cell, None)


def test_cells_are_those_of_the_reference(cells, reference, tmp_path):
    own = [r for r in read_record_set(reference).records if r.environment == "hopper"]
    write_reference([replace(r, horizon=10, seed=3) for r in own], tmp_path / "r.jsonl")
    found = cells(oodd_reference=str(tmp_path / "r.jsonl")).names
    assert len(found) == 8
    assert found[0] == "tiny/hopper/iid::persistence[h=10,seed=3]"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"oodd_detector": "persistenc"}, "unknown detector 'persistenc': did you mean 'persis"),
        ({"oodd_detector": "bad"}, "plug-in 'bad' is broken: ModuleNotFoundError"),
        ({"oodd_detector": "clock"}, "only others, such as .*persistence"),
        ({"oodd_reference": "none.jsonl"}, "no results or reference at 'none.jsonl'"),
        ({"oodd_split": "mini"}, r"nothing in common: .* has split tiny, digest .*, expected"),
        ({"oodd_split": "huge"}, "huge"),
        ({"oodd_env": "hoper"}, "unknown environment 'hoper': did you mean 'hopper'"),
        ({"oodd_fail": ["ac:1"]}, "unknown metric 'ac': did you mean 'auc'"),
        ({"oodd_fail": ["auc:+1"]}, "higher is better"),
    ],
)
def test_what_cannot_be_done_is_a_usage_error(
    cells, reference, monkeypatch, tmp_path, options, message
):
    install(monkeypatch, tmp_path, "bad", "import no_such")
    with pytest.raises(pytest.UsageError, match=message):
        cells(**{"oodd_reference": str(reference)} | options)
