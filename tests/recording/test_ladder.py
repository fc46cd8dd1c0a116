"""The suite ladder: strengths found by what they cost, and splits built with them."""

import io
import json
import math

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("gymnasium")

from oodd_recording import build, calibrate
from oodd_recording.build import build_split
from oodd_recording.values import bound_of, unit_of

from oodd_eval.cli import progress
from oodd_eval.cli.main import main
from oodd_eval.data import condition
from oodd_eval.data.condition import (
    FRACTIONS,
    LEVELS,
    RUNGS,
    WHOLE,
    Condition,
    all_rungs_of,
    conditions_of,
    rungs_of,
    strength_of,
)
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1, SplitDefinition
from oodd_eval.data.split import load_split

pytestmark = pytest.mark.slow

FEW = {"environments": ["cartpole"]}
STRENGTHS = {
    "cartpole": {
        "iid": {"rungs": {"4th": {"strength": 0.5}, "kept99": {"strength": 2.0}}},
        "gravity": {"rungs": {"kept99": {"strength": 0.5}}},
    }
}


@pytest.fixture
def own_ladder(monkeypatch):
    monkeypatch.setattr(condition, "read_ladder", lambda: STRENGTHS)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    place = tmp_path_factory.mktemp("base") / "small"
    return build_split(SplitDefinition("small", 3, 2, 2, 60, 951), place, jobs=1, **FEW)


@pytest.fixture
def in_process(monkeypatch):
    def run(chunks, work, _jobs):
        for chunk in chunks:
            build.record_chunk(chunk, work)
            yield chunk

    monkeypatch.setattr(build, "_run", run)


def graded(base, **changes):
    given = {"name": "up", "train": 3, "calibration": 2, "test": 2, "episode_cap": 60,
             "seed_base": 951, "suite": "ladder", "base": str(base)}  # fmt: skip
    return SplitDefinition(**(given | changes))


# The committed strengths


def test_strengths_rise_from_rung_to_rung_within_their_bound():
    for environment, kinds in condition.read_ladder().items():
        for kind, entry in kinds.items():
            where = f"{environment} {kind}"
            assert entry["unit"] == unit_of(environment, kind), where
            assert entry["bound"] == bound_of(environment, kind), where
            rungs = rungs_of(environment, kind)
            assert [*rungs] == [name for name in RUNGS if name in rungs], where
            assert {*FRACTIONS, "kept99"} <= {*rungs}, where
            strengths = [rung.strength for rung in rungs.values()]
            assert strengths[0] > 0, where
            assert strengths[-1] <= entry["bound"], where
            assert (np.diff(strengths) > 0).all(), where
            for name, rung in rungs.items():
                if name in FRACTIONS:
                    expected = rungs["kept99"].strength * FRACTIONS[name]
                    assert rung.strength == pytest.approx(expected, rel=1e-3), where
                    continue
                assert rung.kept_low <= rung.kept <= rung.kept_high, where
                assert rung.low <= rung.strength * 1.001, where
                assert rung.strength <= rung.high * 1.001, where
                if not rung.reached:
                    assert rung.strength == entry["bound"], where
                    assert name == [*rungs][-1], where


def test_only_robots_have_strengths_for_whole_episodes_and_splits_without_a_cap_take_them():
    for environment, info in ENVIRONMENTS.items():
        capped, whole = (conditions_of("paper", environment, cap) for cap in (300, None))
        for kind in condition.read_ladder()[environment]:
            own = WHOLE in all_rungs_of(environment, kind)
            assert own == (kind in TABLE1 and not info.discrete), (environment, kind)
        for kind in TABLE1:
            expected = "paper" if info.discrete else WHOLE
            assert whole[Condition(kind, "paper")] == strength_of(environment, kind, expected)
            assert capped[Condition(kind, "paper")] == strength_of(environment, kind, "paper")


# Calibration


STEP = 0.3  # from here on the policy fails, in one kind


def curve(strength, scale):
    """A policy that keeps half of its return at a strength of `scale`."""
    return 100 / (1 + strength / scale)


@pytest.fixture
def measured(monkeypatch, tmp_path):
    """A simulator whose returns are known, with noise that all strengths share."""
    calls = []
    noise = np.random.default_rng(0).normal(size=32)

    def measure(environment, kind, strength, twins, *, whole=False):
        calls.append((kind, strength))
        if kind == "bias":
            return [100.0 if strength < STEP else 40.0] * len(twins)
        returns = curve(strength, 0.05 if whole else 0.2) if kind != "stuck" else 100.0
        return list(returns + noise[twins] * strength)

    def twins_of(environment, first, count, *, whole=False):
        return [*range(first - calibrate.FIRST_SEED, first - calibrate.FIRST_SEED + count)]

    class Pool:
        def __init__(self, *_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            return False

        def submit(self, function, *given, **named):
            from concurrent.futures import Future

            done = Future()
            done.set_result(function(*given, **named))
            return done

    monkeypatch.setattr(calibrate, "measure", measure)
    monkeypatch.setattr(calibrate, "workers", Pool)
    monkeypatch.setattr(calibrate, "return_of", lambda _: 100.0)
    monkeypatch.setattr(calibrate, "twins_of", twins_of)

    def go(kinds=("iid",), environments=("hopper",), jobs=1, **options):
        found = calibrate.calibrate(
            tmp_path / "ladder.json", tmp_path / "work.jsonl", environments=environments,
            kinds=kinds, jobs=jobs, **options,
        )  # fmt: skip
        return found["hopper"]

    return go, calls, tmp_path


def test_strengths_are_where_a_known_curve_has_the_levels(measured):
    go, _, _ = measured
    rungs = go()["iid"]["rungs"]
    for name, level in LEVELS.items():
        exact = 0.2 * (1 / level - 1)
        assert rungs[name]["strength"] == pytest.approx(exact, rel=0.12), name
        assert rungs[name]["low"] <= rungs[name]["strength"] <= rungs[name]["high"]
        kept = curve(rungs[name]["strength"], 0.2) / 100
        assert rungs[name]["kept_low"] - 0.01 <= kept <= rungs[name]["kept_high"] + 0.01
        assert rungs[name]["reached"]
    assert rungs["16th"]["strength"] == pytest.approx(rungs["kept99"]["strength"] / 16, rel=1e-3)


def test_a_step_is_found_and_levels_on_it_share_its_two_sides(measured):
    go, _, _ = measured
    rungs = go(kinds=["bias"])["bias"]["rungs"]
    assert [*rungs] == [*FRACTIONS, "kept99", "kept50"]
    (before, after) = (rungs[name] for name in ("kept99", "kept50"))
    assert STEP / calibrate.FINEST <= before["strength"] < STEP <= after["strength"]
    assert after["strength"] <= STEP * calibrate.FINEST
    for rung, kept in (before, 1.0), (after, 0.4):
        assert (rung["kept_low"], rung["kept"], rung["kept_high"]) == (kept, kept, kept)


def test_a_calibration_goes_on_where_it_was_interrupted(measured):
    go, calls, place = measured
    whole = go()
    made = len(calls)
    work = place / "work.jsonl"
    lines = work.read_text().splitlines()
    assert len(lines) == made + 1  # and the nominal returns
    work.write_text("\n".join(lines[:4]) + '\n{"key": [1')
    (place / "ladder.json").unlink()
    calls.clear()
    assert go() == whole
    assert len(calls) == made - 3
    assert len([x for x in work.read_text().splitlines() if x.endswith("}")]) == made + 1
    calls.clear()
    assert go() == whole
    assert calls == []


def test_losses_grow_from_the_nominal_ones_of_each_kind(measured, monkeypatch):
    """They count from the onset, which differs by kind, so each kind has its own nominal losses."""
    go, calls, place = measured
    loss = {"iid": 40.0, "bias": 10.0}

    def measure(environment, kind, strength, twins, *, whole=False):
        assert (kind, strength) not in calls
        calls.append((kind, strength))
        return [-loss[kind] * (1 + strength / 0.2)] * len(twins)

    monkeypatch.setattr(calibrate, "measure", measure)
    monkeypatch.setattr(calibrate, "has_loss", lambda _: True)
    entries = go([*loss])
    for kind in loss:
        assert next(s for k, s in calls if k == kind) == 0.0
        rungs = entries[kind]["rungs"]
        assert rungs["loss10"]["kept"] == pytest.approx(0.9, abs=0.02)
        assert rungs["loss10"]["strength"] == pytest.approx(0.02, rel=0.2)
        assert rungs["loss100"]["strength"] == pytest.approx(0.2, rel=0.2)
    lines = [json.loads(line) for line in (place / "work.jsonl").read_text().splitlines()]
    assert {line["kind"] for line in lines} == {*loss}
    calls.clear()
    assert go([*loss]) == entries
    assert calls == []


def test_seeds_that_workers_share_out_stay_in_their_order(measured):
    go, calls, place = measured
    strengths, work = go(["iid", "bias"]), (place / "work.jsonl").read_text()
    for name in ("ladder.json", "work.jsonl"):
        (place / name).unlink()
    calls.clear()
    assert go(["iid", "bias"], jobs=3) == strengths
    lines = (place / "work.jsonl").read_text().splitlines()
    assert sorted(lines) == sorted(work.splitlines())
    assert len(calls) == 3 * (len(lines) - 1)


def test_progress_has_an_end_that_comes(measured):
    go, calls, _ = measured
    told = []
    kinds = ["iid", "bias", "stuck"]
    go(kinds, progress=lambda *given: told.append(given))
    assert told[0][::2] == (0, "")
    assert told[-1][0] == told[-1][1] == len(calls) + 1  # and the nominal episodes
    assert [done for done, _, _ in told] == [*range(len(calls) + 2)]
    assert all(0.5 <= total / (len(calls) + 1) <= 2 for _, total, _ in told)
    told.clear()
    go(kinds, progress=lambda *given: told.append(given))
    assert told == [(len(calls), len(calls), "")]
    assert go([], progress=lambda *given: told.append(given))


def test_a_calibration_shows_a_bar_or_now_and_then_a_line(monkeypatch):
    def shown(*, terminal, quiet=False, silence=0.0):
        file = io.StringIO()
        console = Console(file=file, force_terminal=terminal, width=80, quiet=quiet)
        monkeypatch.setattr(progress, "make_console", lambda **_: console)
        monkeypatch.setattr(progress, "SILENCE", silence)
        with progress.pace_shown("evaluations", quiet=quiet) as show:
            show(2, 9, "")
            show(3, 8, "hopper iid")
        return file.getvalue()

    first, second = shown(terminal=False).splitlines()
    assert first.startswith("2/9 evaluations, 0:00:00 so far")
    assert "left" not in first  # of an earlier call
    assert second.startswith("3/8 evaluations, ")
    assert second.endswith(" left  hopper iid")
    assert len(shown(terminal=False, silence=60.0).splitlines()) == 1
    assert "3/8 evaluations" in shown(terminal=True)
    assert not shown(terminal=True, quiet=True)
    assert not shown(terminal=False, quiet=True)


def test_on_whole_episodes_one_rung_of_the_papers_kinds_is_found_and_added(measured):
    go, calls, _ = measured
    capped = go(["iid", "delay"])
    calls.clear()
    both = go(["iid", "delay"], ["cartpole", "hopper"], whole=True)
    assert {kind for kind, _ in calls} == {"iid"}
    assert len(calls) < 12
    assert both == capped | {"iid": capped["iid"] | {WHOLE: both["iid"][WHOLE]}}
    found, level = both["iid"][WHOLE], calibrate.levels_of("hopper", "iid", whole=True)[WHOLE]
    assert found["strength"] == pytest.approx(0.05 * (1 / level - 1), rel=0.12)
    assert found["strength"] < 0.5 * both["iid"]["paper"]["strength"]
    assert go(["iid", "delay"]) == both  # and a further calibration of the others keeps it


def test_crossings_worked_by_hand():
    strengths, kept = np.array([1.0, 4.0, 16.0]), np.array([0.98, 0.9, 0.5])
    assert calibrate.crossing(strengths, kept, 0.9) == 4.0
    assert calibrate.crossing(strengths, kept, 0.7) == pytest.approx(8.0)
    assert calibrate.crossing(strengths, kept, 0.99) == pytest.approx(0.5)
    assert calibrate.crossing(strengths, kept, 0.4) == math.inf
    assert [calibrate.nearest(kept, level) for level in (0.99, 0.91, 0.6, 0.1)] == [0, 1, 2, 2]
    flat = np.array([1.0, 1.0, 0.4, 0.4])
    assert [calibrate.nearest(flat, level) for level in (0.99, 0.5)] == [1, 2]


# Splits


def test_a_ladder_has_its_bases_episodes_and_one_part_a_rung(
    base, own_ladder, in_process, tmp_path
):
    split = load_split(build_split(graded(base), tmp_path / "up", **FEW))
    assert split.anomalies[2:] == ("iid@4th", "iid@kept99", "gravity@kept99")
    assert split.anomalies == ("iid", "gravity", "iid@4th", "iid@kept99", "gravity@kept99")
    assert split.train_digest("cartpole") == load_split(base).train_digest("cartpole")
    assert all(check.ok for check in split.verify())
    mine, own = (load_split(p).environment("cartpole") for p in (tmp_path / "up", base))
    for part in ("train", "calibration", "twins"):
        pairs = zip(getattr(mine, part), getattr(own, part), strict=True)
        assert all((a.observations == b.observations).all() for a, b in pairs)
    strong, weak = mine.anomalous("iid@kept99"), mine.anomalous("iid@4th")
    assert [p["strength"] for p in strong.parameters] == [2.0, 2.0]
    assert (strong.onsets == weak.onsets).all()
    assert [p["sensors"] for p in strong.parameters] == [p["sensors"] for p in weak.parameters]
    before = (tmp_path / "up" / "cartpole.h5").stat().st_mtime_ns
    build_split(graded(base), tmp_path / "up", **FEW)
    assert (tmp_path / "up" / "cartpole.h5").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["mine", "--base", "mini"], "expected --suite ladder"),
        (["mine", "--base", "mini", "--suite", "ladder", "--cap", "90"], "none of --train"),
        (["mine", "--suite", "paper"], "or --base with a split that has them"),
        (["ladder", "--base", "mini", "--suite", "ladder"], "is published"),
        (["mine", "--train", "1", "--calibration", "1", "--test", "1", "--seed-base", "41",
          "--noise", "3"], "the noise must be 0 to 1 of the spread, got 3.0"),
    ],
)  # fmt: skip
def test_wrong_recipes_are_refused(options, message, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path))
    assert main(["data", "build", *options]) == 4
    assert message in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_a_split_of_ones_own_gets_a_ladder(base, own_ladder, in_process, tmp_path):
    place, output = str(tmp_path / "mine"), str(tmp_path / "out")
    assert main(["data", "build", "mine", "--base", str(base), "--suite", "ladder", "--env",
                 "cartpole", "--output", place]) == 0  # fmt: skip
    assert load_split(place).conditions("cartpole")[0] == Condition("iid", "4th")
    assert main(["run", "--detector", "clock", "--env", "cartpole", "--anomaly", "iid", "--split",
                 place, "--output", output]) == 0  # fmt: skip
    lines = (tmp_path / "out" / "records.jsonl").read_text().splitlines()
    assert [(json.loads(x)["anomaly"], json.loads(x)["strength"]) for x in lines] == [
        ("iid", "4th"), ("iid", "kept99"),
    ]  # fmt: skip
    assert main(["show", output, "--split", place]) == 0
    # Noise is part of the recipe and of every episode.
    recipe = SplitDefinition("loud", 3, 2, 2, 60, 951, noise=0.05)
    loud = load_split(build_split(recipe, tmp_path / "loud", **FEW))
    assert loud.manifest["definition"]["noise"] == 0.05
    assert "noise" not in load_split(base).manifest["definition"]
    noisy, clean = (s.environment("cartpole").train for s in (loud, load_split(base)))
    assert noisy[0].observations[0].tolist() != clean[0].observations[0].tolist()
