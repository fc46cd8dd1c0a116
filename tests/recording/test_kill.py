"""A run that is killed at any moment loses no finished unit, and ends as if it never had been."""

import json
import signal

import h5py
import pytest
from helpers_plugins import install
from helpers_processes import SLOW, environment, oodd_eval, wait_until, workers_of

from oodd_eval.results.directory import FitStore, ResultsDirectory

pytestmark = pytest.mark.slow

POINTS = (
    "fit:1", "score:5", "state:1", "move:1", "moved:1", "restore:1", "cell:1", "move:4",
    "finished:1",
)  # fmt: skip
"""Points in a run at which the harness is killed, when they are reached so many times.

Of the later ones, not all are reached in every order in which two threads finish their units.
"""

VOLATILE = {"seconds_fit", "seconds_score", "peak_rss_mb"}
VOLATILE_PROVENANCE = {"time", "command", "git_commit", "git_dirty"}


def stable(path):
    """Lines of a results directory without cost and time."""
    lines = []
    for line in (path / "records.jsonl").read_text().splitlines():
        plain = {k: v for k, v in json.loads(line).items() if k not in VOLATILE}
        origin = plain["provenance"].items()
        plain["provenance"] = {k: v for k, v in origin if k not in VOLATILE_PROVENANCE}
        lines.append(json.dumps(plain))
    return lines


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    path = tmp_path_factory.mktemp("plugin")
    with pytest.MonkeyPatch.context() as patch:
        install(patch, path, "slow", SLOW)
    return path


def start(tiny_split, plugin, fits, output, *more, seeds="0,1,2,3", jobs=2, pause=0.1,
          **variables):  # fmt: skip
    return oodd_eval(
        "run", "--detector", "slow", *more, "--env", "all", "--anomaly", "iid,gravity", "--split",
        tiny_split, "--seed", seeds, "--jobs", jobs, "--output", output, "--param",
        f"pause={pause}", env=environment(plugin, fits, RUN=str(output), **variables),
    )  # fmt: skip


def finish(process):
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    return output


def fits_in(log):
    return (
        [tuple(line.split()[1:]) for line in log.read_text().splitlines()] if log.exists() else []
    )


def units_by_file(output):
    """Names of score files, with the fit that each is of as the log of fits names it."""
    dimensions = {"cartpole": "4", "hopper": "15"}
    return {
        f"{r.scores}.h5": (
            dimensions[r.environment],
            "any" if r.detector == "keeps" else str(r.horizon),
            str(r.seed),
        )
        for r in ResultsDirectory(output).records()
    }


def test_killed_at_chosen_points_it_ends_like_an_uninterrupted_run(tiny_split, plugin, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    more = ("--detector", "slow,keeps", "--horizon", "1,2")
    finish(start(tiny_split, plugin, tmp_path / "whole-fits", whole, *more, seeds="0", pause=0.01))
    begun_fits = fits_in(tmp_path / "whole-fits")
    unit_of = units_by_file(whole)
    # On two environments one detector fits for each of two horizons, the other for both at once.
    assert len(unit_of) == 8
    assert len(begun_fits) == 6
    assert set(begun_fits) == set(unit_of.values())

    kept, marker, fits, ends = {}, f"RUN={killed}", [], []
    for attempt, point in enumerate(POINTS):
        log = tmp_path / f"fits-{attempt}"
        process = start(
            tiny_split, plugin, log, killed, *more, seeds="0", pause=0.01, KILL_AT=point
        )
        process.communicate()
        ends.append(process.returncode)
        assert wait_until(lambda: not workers_of(marker)), "a worker outlived the harness"
        fits += fits_in(log)
        assert not {unit_of[name] for name in kept} & set(fits_in(log)), "fitted again"
        for name, content in kept.items():
            assert (killed / "scores" / name).read_bytes() == content, "finished scores changed"
        kept = {f.name: f.read_bytes() for f in (killed / "scores").glob("*.h5")}
        for name in kept:
            with h5py.File(killed / "scores" / name) as scores:
                assert len(scores["test/nominal/scores"]) == scores["test/nominal/offsets"][-1]
        if (killed / "records.jsonl").exists():
            assert set(stable(killed)) <= set(stable(whole))
    assert set(ends) <= {-signal.SIGKILL, 0}
    assert ends.count(-signal.SIGKILL) >= 6
    last = tmp_path / "last-fits"
    finish(start(tiny_split, plugin, last, killed, *more, seeds="0", pause=0.01))
    assert not {unit_of[name] for name in kept} & set(fits_in(last))

    assert stable(killed) == stable(whole)
    assert set(begun_fits) <= {*fits, *fits_in(last)}
    for part in ("", "scores", "logs", "fitted"):
        assert not list((killed / part).glob(".*"))
    for part in ("scores", "fitted"):
        names = [{f.name for f in (place / part).iterdir()} for place in (whole, killed)]
        assert names[0] == names[1]
    for fit in (killed / "fitted").iterdir():
        assert FitStore(killed / "fitted").find(fit.stem), "a fit is not whole"


def test_an_interrupted_command_ends_with_2_and_keeps_its_records(tiny_split, plugin, tmp_path):
    log, output = tmp_path / "fits", tmp_path / "out"
    process = start(tiny_split, plugin, log, output, seeds="0,1", jobs=1, ENDLESS="1")
    # The second fit has begun and never ends, and the records of the first are written.
    assert wait_until(lambda: len(fits_in(log)) == 2 and (output / "records.jsonl").exists())
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "2 ok in" in printed
    assert "interrupted" in printed
    assert "1 of 4 fits kept; the same command continues" in printed
    assert {r.seed for r in ResultsDirectory(output).records()} == {0}
    assert not workers_of(f"RUN={output}")
