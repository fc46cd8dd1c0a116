"""Where units are carried out changes no record; what cannot be used is said before any work."""

import contextlib
import json
import re
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_plugins import install
from helpers_processes import SLOW, Cluster, environment, oodd_eval, wait_until, workers_of

from oodd_eval import load_split
from oodd_eval.errors import SplitError, UsageError
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.executors import Executor, RunSettings, check_executor
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.unit import UnitJob

pytestmark = pytest.mark.slow

remote = pytest.importorskip("oodd_eval.scoring.executors.dask", reason="needs the extra dask")

VOLATILE = {"seconds_fit", "seconds_score", "peak_rss_mb", "provenance"}
NEVER = threading.Event()


@pytest.fixture
def job(tiny_split):
    """The clock's unit on cartpole."""
    with unit_of(tiny_split, "clock") as job:
        yield job


@contextlib.contextmanager
def unit_of(split_name, detector):
    """A detector's unit on cartpole."""
    split, plugins = load_split(split_name), discover()
    plan = make_plan(
        plugins, split=split, detectors=[detector],
        environments=["cartpole"], anomalies=["iid"],
    )  # fmt: skip
    data = split.environment("cartpole")
    yield UnitJob(plan, plan.units[0], data, plugins.offer(detector))
    data.close()


@pytest.fixture(autouse=True)
def closed_files():
    """Close the splits that a worker of a cluster keeps open."""
    yield
    remote._environment.cache_clear()


def ordered(job, tiny_split, limits=Limits(), stop=NEVER.is_set, **changes):  # noqa: B008
    """Send an order through JSON, as to another machine, and return what comes back."""
    order = json.loads(json.dumps(remote.order_of(job, load_split(tiny_split), limits)))
    for place, value in changes.items():
        part, _, name = place.partition("__")
        order[part] = {**order[part], name: value} if name else value
    return remote.run_order(order, stop)


@pytest.mark.parametrize(
    "name", ["", "dusk://h:1", "dask://", "dask://h", "dask://h:x", "dask://h:1/x"]
)
def test_an_executor_that_does_not_exist_is_refused(name):
    with pytest.raises(UsageError, match="expected 'local' or 'dask://HOST:PORT'"):
        check_executor(name)


def test_an_order_is_json_and_gives_the_scores_of_a_local_unit(job, tiny_split):
    there = ordered(job, tiny_split)
    here = Executor(RunSettings(jobs=1), None, NEVER)(job)
    assert there["status"] == here.status == "ok"
    assert {k: [s.tolist() for s in v] for k, v in there["parts"].items()} == {
        k: [s.tolist() for s in v] for k, v in here.file.parts.items()
    }


def test_explanations_and_namings_come_back_with_the_scores():
    with unit_of("mini", "mewma-a") as job:  # a smaller split has no guaranteed alarms
        there = ordered(job, "mini")
        here = Executor(RunSettings(jobs=1), None, NEVER)(job).file
    assert here.namings["test/iid"].any()
    for name in ("parts", "explained", "namings"):
        assert there[name].keys() == getattr(here, name).keys()
        for part, episodes in getattr(here, name).items():
            for rows, expected in zip(there[name][part], episodes, strict=True):
                np.testing.assert_array_equal(rows, expected)


def test_a_sandbox_travels_with_the_order(job, tiny_split):
    if not shutil.which("bwrap"):
        pytest.skip("needs bubblewrap")
    from oodd_leaderboard.sandbox.launcher import make_sandbox

    launcher = make_sandbox([tiny_split])
    here = Executor(RunSettings(jobs=1), None, NEVER)(job)
    there = ordered(replace(job, launcher=launcher, streamed=True), tiny_split)
    assert there["status"] == "ok", there["reason"]
    assert [s.tolist() for s in there["parts"]["test/iid"]] == [
        s.tolist() for s in here.file.parts["test/iid"]
    ]
    made = remote._launcher(json.dumps(launcher.elsewhere, sort_keys=True), None)[0]
    assert made.elsewhere == launcher.elsewhere
    assert made is not launcher


def test_limits_travel_with_the_order_and_work_that_nobody_waits_for_is_given_up(job, tiny_split):
    found = ordered(job, tiny_split, Limits(seconds=0.001, memory=10**10))
    assert (found["status"], found["reason"]) == ("timeout", "not done after 0.001 s (--timeout)")
    found = ordered(job, tiny_split, stop=lambda: True)
    assert (found["status"], found["reason"]) == ("error", "interrupted")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": "99"}, r"it has oodd-eval \S+, expected 99 as on this side"),
        ({"unit__source": "0" * 64}, r"plug-in 'trivial' has the source .* expected '0000"),
        ({"unit__version": "9.9"}, r"plug-in 'trivial' has the version .* expected '9.9'"),
        ({"unit__plugin": "no-such"}, "no-such"),
        ({"plan__split_digest": "f" * 64}, r"digest ffffffffffff is not there \(.*tiny has the"),
    ],
)
def test_what_differs_on_the_other_machine_is_refused(job, tiny_split, change, message):
    assert re.search(message, ordered(job, tiny_split, **change)["refused"])


def test_a_split_that_lies_elsewhere_is_found_by_its_name(tiny_split, tmp_path, monkeypatch):
    (tmp_path / "tiny").symlink_to(tiny_split)
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path))
    digest = load_split(tiny_split).digest
    found = remote._environment("/no/such/place", "tiny", digest, "hopper")
    assert found.id == "hopper"
    with pytest.raises(SplitError, match="not there"):
        remote._environment("/no/such/place", "tiny", "f" * 64, "hopper")


# On a cluster


def command(tiny_split, output, *more):
    return (
        "run", "--detector", "slow", "--env", "all", "--anomaly", "iid,gravity", "--split",
        tiny_split, "--seed", "0,1,2", "--param", "pause=0.4", "--output", output, *more,
    )  # fmt: skip


def stable(path):
    plain = [json.loads(record.to_json()) for record in ResultsDirectory(path).records()]
    return [{k: v for k, v in p.items() if k not in VOLATILE} for p in plain]


TELLS = """
class Tells(Good):
    def fit(self, nominal, progress):
        super().fit(nominal)
        progress(0.25)
        time.sleep(1)

@hookimpl
def oodd_detectors():
    return offer(tells=Tells)
"""


def test_from_a_cluster_is_heard_how_far_a_fit_is(tiny_split, monkeypatch, tmp_path):
    plugin, heard = tmp_path / "plugin", []
    install(monkeypatch, plugin, "tells", TELLS)
    cluster = Cluster(tmp_path, environment(plugin, tmp_path / "fits"), workers=1)
    try:
        with unit_of(tiny_split, "tells") as job:
            executor = remote.DaskExecutor(
                cluster.address, RunSettings(), load_split(tiny_split), None
            )
            scored = executor(job, heard.append)
            executor.close()
    finally:
        cluster.close()
    assert scored.status == "ok", scored.reason
    assert heard[:1] == [0.25]
    assert heard == sorted(heard)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks into /proc")
def test_a_cluster_that_loses_a_worker_gives_the_same_records(tiny_split, monkeypatch, tmp_path):
    plugin, log = tmp_path / "plugin", tmp_path / "fits"
    install(monkeypatch, plugin, "slow", SLOW)
    variables = environment(plugin, log, RUN=str(tmp_path))
    marker = f"RUN={tmp_path}"
    with oodd_eval(*command(tiny_split, tmp_path / "here"), env=variables) as here:
        output, _ = here.communicate(timeout=300)
    assert here.returncode == 0, output
    log.unlink()

    with contextlib.ExitStack() as stack:
        cluster = Cluster(tmp_path, variables, workers=2)
        stack.callback(cluster.close)
        address = cluster.address.replace("tcp://", "dask://")
        place = ("--executor", address)
        run = oodd_eval(*command(tiny_split, tmp_path / "there", *place), env=variables)
        stack.callback(run.communicate)
        stack.callback(run.kill)
        assert wait_until(lambda: log.exists() and len(log.read_text().splitlines()) >= 2)
        before = workers_of(marker)
        cluster.processes[1].kill()
        # What it was doing ends with it.
        assert wait_until(lambda: len(workers_of(marker)) < len(before) or len(before) < 2)
        output, _ = run.communicate(timeout=300)
        assert run.returncode == 0, output
        assert stable(tmp_path / "there") == stable(tmp_path / "here")
        assert len(log.read_text().splitlines()) >= 6

        again = oodd_eval(*command(tiny_split, tmp_path / "there", *place), env=variables)
        output, _ = again.communicate(timeout=300)
        assert "12 from earlier runs" in output

        # A killed harness is forgotten: what it had ordered ends.
        log.unlink()
        killed = oodd_eval(
            *command(tiny_split, tmp_path / "killed", *place, "--param", "pause=600"), env=variables
        )
        assert wait_until(log.exists)
        assert workers_of(marker)
        killed.kill()
        killed.communicate()
        assert wait_until(lambda: not workers_of(marker))

        cluster.processes[2].kill()
        cluster.processes[2].wait()
        done = oodd_eval(*command(tiny_split, tmp_path / "none", *place), env=variables)
        output, _ = done.communicate(timeout=300)
        assert done.returncode == 4
        assert "has no workers: start some with `dask worker tcp://127.0.0.1:" in output


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("d.CONNECT_SECONDS = 0.2", "no Dask scheduler answers at tcp://127.0.0.1:9"),
        ("sys.modules.pop(d.__name__); sys.modules['distributed'] = None", "oodd-eval[dask]"),
    ],
)
def test_what_is_missing_is_named(tiny_split, tmp_path, change, message):
    code = (
        f"import oodd_eval.scoring.executors.dask as d, sys; {change}\n"
        "from oodd_eval.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    arguments = ["run", "--detector", "clock", "--env", "hopper", "--split", str(tiny_split),
                 "--output", str(tmp_path), "--executor", "dask://127.0.0.1:9"]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 4
    assert message in done.stderr
