"""Where units are carried out changes no record; what cannot be used is said before any work."""

import contextlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from helpers_plugins import install
from helpers_processes import SLOW, environment, oodd_eval, wait_until, workers_of

from oodd_eval import load_split
from oodd_eval.errors import ExecutorError, SplitError, UsageError
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.supervisor import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.executors import Orders, opener, remote
from oodd_eval.scoring.executors.local import LocalExecutor
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.unit import UnitJob

VOLATILE = {"seconds_fit", "seconds_score", "peak_rss_mb", "provenance"}
NEVER = threading.Event()


@pytest.fixture
def job(tiny_split):
    """The clock's unit on cartpole."""
    split, plugins = load_split(tiny_split), discover()
    plan = make_plan(
        plugins, split=split.name, split_digest=split.digest, detectors=["clock"],
        environments=["cartpole"], anomalies=["iid"],
    )  # fmt: skip
    data = split.environment("cartpole")
    yield UnitJob(plan, plan.units[0], data, plugins.offer("clock"))
    data.close()


@pytest.fixture(autouse=True)
def closed_files():
    """Close the splits that a worker of a cluster keeps open."""
    yield
    remote._environment.cache_clear()


def order(job, tiny_split, **changes):
    return {**remote.order_of(job, load_split(tiny_split), Limits()), **changes}


@pytest.mark.parametrize(
    "name", ["", "dusk://h:1", "dask://", "dask://h", "dask://h:x", "dask://h:1/x"]
)
def test_an_executor_that_does_not_exist_is_refused(name):
    with pytest.raises(UsageError, match="expected 'local' or 'dask://HOST:PORT'"):
        opener(name)


def test_the_local_executor_uses_all_cores_unless_told(tiny_split):
    orders = Orders(load_split(tiny_split), Limits(), None, fresh=False)
    assert opener("local")(orders, 3).jobs == 3
    assert opener("local")(orders, None).jobs == len(os.sched_getaffinity(0))


def test_an_order_is_json_and_gives_the_scores_of_a_local_unit(job, tiny_split):
    sent = json.loads(json.dumps(order(job, tiny_split)))
    there = remote.scored_of(remote.carry_out(sent, NEVER))
    here = LocalExecutor(1, Limits(), None, NEVER)(job)
    assert there.status == here.status == "ok"
    assert {k: [s.tolist() for s in v] for k, v in there.file.parts.items()} == {
        k: [s.tolist() for s in v] for k, v in here.file.parts.items()
    }


def test_limits_travel_with_the_order(job, tiny_split):
    sent = remote.order_of(job, load_split(tiny_split), Limits(seconds=0.001, memory=10**10))
    scored = remote.scored_of(remote.carry_out(sent, NEVER))
    assert (scored.status, scored.reason) == ("timeout", "not done after 0.001 s (--timeout)")


def test_work_that_nobody_waits_for_is_given_up(job, tiny_split):
    stop = threading.Event()
    stop.set()
    scored = remote.scored_of(remote.carry_out(order(job, tiny_split), stop))
    assert (scored.status, scored.reason) == ("error", "interrupted")


def test_another_version_of_the_package_is_refused(job, tiny_split):
    with pytest.raises(ExecutorError, match=r"it has oodd-eval \S+, expected 99 as on this side"):
        remote.scored_of(remote.carry_out(order(job, tiny_split, version="99"), NEVER))


def test_other_code_of_a_plugin_is_refused(job, tiny_split):
    sent = order(job, tiny_split)
    sent["key"] = {**sent["key"], "source": "0" * 64}
    with pytest.raises(ExecutorError, match=r"plug-in 'trivial' has the source .* expected '0000"):
        remote.scored_of(remote.carry_out(sent, NEVER))


def test_a_missing_plugin_is_refused(job, tiny_split):
    with pytest.raises(ExecutorError, match="no-such"):
        remote.scored_of(remote.carry_out(order(job, tiny_split, plugin="no-such"), NEVER))


def test_a_split_with_another_digest_is_refused_with_the_places_looked_at(job, tiny_split):
    sent = order(job, tiny_split)
    sent["plan"] = {**sent["plan"], "split_digest": "f" * 64}
    sent["key"] = {**sent["key"], "split_digest": "f" * 64}
    with pytest.raises(ExecutorError, match=r"digest ffffffffffff is not there \(.*tiny has the"):
        remote.scored_of(remote.carry_out(sent, NEVER))


def test_a_split_that_lies_elsewhere_is_found_by_its_name(tiny_split, tmp_path, monkeypatch):
    (tmp_path / "tiny").symlink_to(tiny_split)
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path))
    digest = load_split(tiny_split).digest
    found = remote._environment("/no/such/place", "tiny", digest, "hopper")
    assert found.id == "hopper"
    with pytest.raises(SplitError, match="not there"):
        remote._environment("/no/such/place", "tiny", "f" * 64, "hopper")


# On a cluster


dask = pytest.mark.skipif(
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", "import distributed"], check=False,
        capture_output=True,
    ).returncode != 0,
    reason="needs the extra dask",
)  # fmt: skip


class Cluster:
    """A scheduler and workers with one thread each, on loopback."""

    def __init__(self, path, variables, workers):
        self.path, self._variables = path, variables
        self.processes = []
        file = path / "scheduler.json"
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", file)
        assert wait_until(lambda: file.exists() and file.read_text().strip())
        self.address = json.loads(file.read_text())["address"]
        for number in range(workers):
            self._start(
                "worker", self.address, "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1",
                "--local-directory", path / f"worker-{number}",
            )  # fmt: skip
        logs = [path / f"{number}.log" for number in range(1, workers + 1)]
        assert wait_until(lambda: all("Registered to" in g.read_text() for g in logs))

    def _start(self, *arguments):
        log = (self.path / f"{len(self.processes)}.log").open("w")
        command = [sys.executable, "-m", "dask", *map(str, arguments), "--no-dashboard"]
        with log:
            self.processes.append(
                subprocess.Popen(command, stdout=log, stderr=log, env=self._variables)
            )

    def close(self):
        for process in self.processes:
            process.kill()
            process.wait()


def command(tiny_split, output, *more):
    return (
        "run", "--detector", "slow", "--env", "all", "--anomaly", "iid,gravity", "--split",
        tiny_split, "--seed", "0,1,2", "--param", "pause=0.4", "--output", output, *more,
    )  # fmt: skip


def stable(path):
    plain = [json.loads(record.to_json()) for record in ResultsDirectory(path).records()]
    return [{k: v for k, v in p.items() if k not in VOLATILE} for p in plain]


@dask
@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks into /proc")
def test_a_cluster_that_loses_a_worker_gives_the_same_records(tiny_split, monkeypatch, tmp_path):
    plugin, log = tmp_path / "plugin", tmp_path / "fits"
    install(monkeypatch, plugin, "slow", SLOW)
    variables = environment(plugin, log, RUN=str(tmp_path))
    marker = f"RUN={tmp_path}".encode()
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
            *command(tiny_split, tmp_path / "killed", *place, "--param", "pause=600"),
            env=variables,
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


@dask
def test_an_address_where_nobody_answers_is_named(tiny_split, tmp_path):
    code = (
        "import oodd_eval.scoring.executors.dask as d, sys; d.CONNECT_SECONDS = 0.2;"
        "from oodd_eval.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    arguments = ["run", "--detector", "clock", "--env", "hopper", "--split", str(tiny_split),
                 "--output", str(tmp_path), "--executor", "dask://127.0.0.1:9"]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 4
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in done.stderr


def test_without_dask_the_extra_is_named(tiny_split, tmp_path):
    code = (
        "import sys; sys.modules['distributed'] = None;"
        "from oodd_eval.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    arguments = ["run", "--detector", "clock", "--env", "hopper", "--split", str(tiny_split),
                 "--output", str(tmp_path), "--executor", "dask://127.0.0.1:9"]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 4
    assert "pip install 'oodd-eval[dask]'" in done.stderr
