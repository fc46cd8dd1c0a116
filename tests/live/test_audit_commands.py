"""What an audit of logs met, once more: by commands and calls that were there before it.

So that each of these can be run on the code of then, where all of them fail.
"""

import csv
import json

import numpy as np
import pytest
from oodd_live import Watchdog

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.errors import UsageError
from oodd_eval.metrics.alarms import GuaranteedAlarm

ROWS = 60


def episode(seed, slip=None, shift=0.0):
    """Two sensors that follow one another; from the slip on the second is a metre off."""
    rng = np.random.default_rng(seed)
    first = rng.normal(size=ROWS).cumsum() * 0.1 + shift
    second = 2 * first + rng.normal(size=ROWS) * 0.1
    if slip is not None:
        second[slip:] += 1.0
    return {"obs:a": first, "obs:b": second}


def write(path, columns, separator=",", decimal="."):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        table = csv.writer(file, delimiter=separator)
        table.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            # Repr keeps all digits of float64.
            table.writerow([repr(float(cell)).replace(".", decimal) for cell in row])


def parts(root, train=20, calibration=20, change=lambda _part, columns: columns, **layout):
    for part, count in (("train", train), ("calibration", calibration)):
        for i in range(count):
            seed = 1000 * (part == "train") + i
            write(root / part / f"{i:02}.csv", change(part, episode(seed)), **layout)


def pairs(root, kind="slip", count=20, change=lambda columns: columns, onset=30):
    for i in range(count):
        seed = 5000 + i
        write(root / "test" / "nominal" / f"{i:02}.csv", change(episode(seed)))
        write(root / "test" / kind / f"{i:02}.csv", change(episode(seed, slip=onset)))
    lines = [f"{i:02}.csv,{onset}" for i in range(count)]
    (root / "test" / kind / "onsets.csv").write_text("\n".join(["file,onset", *lines]))


def take(root, *further, form="csv"):
    """Import parts as one could before, by options."""
    test = ["--test", str(root / "test")] if (root / "test").exists() else []
    return main(["data", "import", "plant", "--env", "pump", "--format", form,
                 "--train", str(root / "train"), "--calibration", str(root / "calibration"),
                 "--output", str(root / "split"), *test, *further])  # fmt: skip


def run(root, detectors):
    arguments = ["run", "--detector", detectors, "--env", "pump", "--split", str(root / "split")]
    code = main([*arguments, "--output", str(root / "results")])
    lines = (root / "results" / "records.jsonl").read_text().splitlines()
    return code, {record["detector"]: record for record in map(json.loads, lines)}


def pump(root):
    return load_split(root / "split").environment("pump")


def recipe(root, text):
    (root / "plant.toml").write_text('split = "plant"\nenvironment = "pump"\n' + text)
    return main(["data", "import", str(root / "plant.toml"), "--output", str(root / "split")])


# 1: no faulty run has a twin, nobody's anomalies have the same names


def test_faulty_logs_without_twins_are_imported_and_run(tmp_path):
    parts(tmp_path, 10, 10)
    for i in range(3):
        write(tmp_path / "slips" / f"slip-{i}.csv", episode(50 + i, slip=30))
    write(tmp_path / "leaks" / "leak.csv", episode(60, slip=30))
    assert not recipe(
        tmp_path,
        """
        onset = 30
        [nominal]
        files = ["train/*.csv", "calibration/*.csv"]
        [anomalous.slip]
        files = ["slips/*.csv"]
        [anomalous.leak]
        files = ["leaks/*.csv"]
        """,
    )
    code, records = run(tmp_path, "mahalanobis")
    assert not code
    assert records["mahalanobis"]["metrics"]["auc_pool"]["value"] > 0.8


def test_a_split_without_test_episodes_of_anomalies_can_be_run(tmp_path):
    parts(tmp_path, 40, 30)
    assert not recipe(tmp_path, '[nominal]\nfiles = ["train/*.csv", "calibration/*.csv"]\n')
    code, records = run(tmp_path, "range")
    assert not code
    assert "false_episodes_at_10pct" in records["range"]["metrics"]


# 2: twins that were made up


def test_twins_of_another_day_give_no_matched_auc(tmp_path):
    parts(tmp_path)
    pairs(tmp_path)
    for i in range(20):
        write(tmp_path / "test" / "slip" / f"{i:02}.csv", episode(i, slip=30, shift=3.0))
    assert not take(tmp_path)
    _, records = run(tmp_path, "mahalanobis")
    assert "auc_matched" not in records["mahalanobis"]["metrics"]


# 3: machines drift, and nothing asks


def drifting(root):
    """The machine warms up: each episode a little more."""
    count = iter(range(1000))

    def warmer(_part, columns):
        return columns | {"obs:b": columns["obs:b"] + 0.1 * next(count)}

    parts(root, change=warmer)
    assert not take(root)


def test_a_drift_is_said_by_data_info(tmp_path, capsys):
    drifting(tmp_path)
    capsys.readouterr()
    assert not main(["data", "info", str(tmp_path / "split")])
    printed = " ".join(capsys.readouterr().out.split())
    assert "drift" in printed
    assert "mean of b" in printed


def test_a_drift_is_said_by_a_watchdog_before_there_is_an_alarm(tmp_path):
    drifting(tmp_path)
    data = pump(tmp_path)
    with pytest.warns(UserWarning, match="drift"):
        Watchdog.fit("mewma", data.train, data.calibration, 0.10)


# 4: a threshold that nothing exceeds


def test_one_calibration_episode_out_of_range_makes_no_deaf_watchdog(tmp_path):
    parts(tmp_path, calibration=19)
    columns = episode(0)
    columns["obs:a"][20:30] += 1000.0
    write(tmp_path / "calibration" / "00.csv", columns)
    assert not take(tmp_path)
    data = pump(tmp_path)
    with pytest.raises(UsageError, match="range"):
        Watchdog.fit("mewma", data.train, data.calibration, 0.05)


@pytest.mark.parametrize("kind", ["cusum", "score"])
def test_eight_calibration_episodes_make_no_alarm_at_10_percent(kind):
    with pytest.raises(UsageError, match="8"):
        GuaranteedAlarm.fit([np.arange(9.0) + i for i in range(8)], 0.10, kind)


# 5: anomalies end


def test_an_anomaly_ends(tmp_path):
    parts(tmp_path, 10, 10)
    columns = episode(50, slip=30) | {"fault": np.isin(np.arange(ROWS), range(30, 45))}
    write(tmp_path / "slips" / "slip.csv", columns)
    for path in (tmp_path / "train").iterdir():
        write(path, episode(int(path.stem)) | {"fault": np.zeros(ROWS)})
    assert not recipe(
        tmp_path,
        """
        labels = "fault"
        [nominal]
        train = ["train/*.csv"]
        calibration = ["calibration/*.csv"]
        [anomalous.slip]
        files = ["slips/*.csv"]
        """,
    )
    assert pump(tmp_path).labelled("slip").intervals == [((30, 45),)]


# 6: files as loggers write them


@pytest.mark.parametrize("names", [("obs:a", " obs:b"), ("obs:a", "Obs:b")])
def test_no_column_vanishes_by_its_spelling(tmp_path, names):
    parts(tmp_path, 2, 2, lambda _part, c: dict(zip(names, c.values(), strict=True)))
    assert not take(tmp_path)
    assert [q.name for q in pump(tmp_path).sensors] == ["a", "b"]


@pytest.mark.parametrize("name", ["obs_b", "observation b"])
def test_a_column_that_is_nearly_named_right_is_an_error(tmp_path, capsys, name):
    parts(tmp_path, 2, 2, lambda _part, c: {"obs:a": c["obs:a"], name: c["obs:b"]})
    assert take(tmp_path) == 4
    assert name in capsys.readouterr().err


def test_other_columns_are_listed(tmp_path, capsys):
    parts(tmp_path, 2, 2, lambda _part, c: c | {"flow": c["obs:b"]})
    assert not take(tmp_path)
    assert "flow" in capsys.readouterr().out


def test_semicolons_and_decimal_commas_are_read(tmp_path):
    parts(tmp_path, 2, 2, separator=";", decimal=",")
    assert not take(tmp_path)
    rows = pump(tmp_path).train[0].observations
    assert rows[:, 1] == pytest.approx(episode(1000)["obs:b"], rel=1e-6)


def test_a_missing_value_comes_with_its_remedy(tmp_path, capsys):
    parts(tmp_path, 2, 2)
    path = tmp_path / "train" / "00.csv"
    lines = path.read_text().splitlines()
    lines[5] = "," + lines[5].split(",")[1]
    path.write_text("\n".join(lines))
    assert take(tmp_path) == 4
    assert "hold" in capsys.readouterr().err


def test_as_many_actions_as_states_are_taken(tmp_path):
    rng = np.random.default_rng(0)
    for part in ("train", "calibration"):
        (tmp_path / part).mkdir()
        rows, commands = rng.normal(size=(20, 2)), np.arange(20.0)[:, None]
        np.savez(tmp_path / part / "0.npz", observations=rows, actions=commands)
    assert not take(tmp_path, form="numpy")
    assert pump(tmp_path).train[0].actions[:, 0].tolist() == [*range(19)]


def test_actions_under_another_name_do_not_vanish(tmp_path):
    rng = np.random.default_rng(0)
    for part in ("train", "calibration"):
        (tmp_path / part).mkdir()
        rows, commands = rng.normal(size=(20, 2)), rng.normal(size=(19, 1))
        np.savez(tmp_path / part / "0.npz", observations=rows, action=commands)
    assert not take(tmp_path, form="numpy")
    assert len(pump(tmp_path).actions) == 1


def test_an_anomaly_may_have_an_underscore(tmp_path):
    parts(tmp_path, 2, 2)
    pairs(tmp_path, "front_tyre", count=2)
    assert not take(tmp_path)
    assert pump(tmp_path).anomalies == ("front_tyre",)


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        ("file, onset\n00.csv, 30", ""),
        ("file,onset\n00.csv,31\n00.csv,30", "twice"),
        ("file,onset\n00.csv,30\nzero.csv,30", "zero.csv"),
    ],
)
def test_onsets_with_blanks_are_read_and_doubles_and_unknown_files_refused(
    tmp_path, capsys, lines, word
):
    parts(tmp_path, 2, 2)
    pairs(tmp_path, count=1)
    (tmp_path / "test" / "slip" / "onsets.csv").write_text(f"{lines}\n")
    assert take(tmp_path) == (4 if word else 0)
    assert word in capsys.readouterr().err


def test_irregular_stamps_do_not_pass(tmp_path, capsys):
    stamps = np.arange(ROWS) + 500 * (np.arange(ROWS) > 30)
    parts(tmp_path, 2, 2, lambda _part, c: {"t": stamps} | c)
    text = 'time = "t"\n[nominal]\ntrain = "train/*.csv"\ncalibration = "calibration/*.csv"\n'
    assert recipe(tmp_path, text) == 4
    assert "gap of 501 s" in capsys.readouterr().err


def test_a_transposed_matrix_does_not_pass(tmp_path, capsys):
    rng = np.random.default_rng(0)
    (tmp_path / "logs").mkdir()
    for i in range(3):
        rows = rng.normal(size=(200, 3)).cumsum(axis=0)
        np.savetxt(tmp_path / "logs" / f"{i}.dat", rows.T if i == 1 else rows)
    assert not main(["data", "inspect", str(tmp_path / "logs")])
    assert "1.dat" in capsys.readouterr().out


# 7: float32


def test_a_northing_has_the_figures_that_it_has_without_the_offset(tmp_path):
    metrics = []
    for offset in (0.0, 5.4e6):
        root = tmp_path / f"{offset:g}"

        def far(columns, offset=offset):
            return {name: 0.3 * column for name, column in columns.items()} | {
                "obs:b": 0.3 * columns["obs:b"] + offset
            }

        parts(root, 20, 20, lambda _part, columns, far=far: far(columns))
        pairs(root, change=far)
        assert not take(root)
        _, records = run(root, "mahalanobis")
        metrics.append(records["mahalanobis"]["metrics"])
    near, away = metrics
    assert near["auc"]["value"] > 0.6
    for name in ("auc", "auc_matched", "found_within_100_at_10pct", "missed_at_10pct"):
        assert away[name]["value"] == pytest.approx(near[name]["value"], abs=0.005), name


# 8: which level needs how many calibration episodes


def test_thirty_calibration_episodes_are_said_to_be_too_few_for_a_cusum_at_5_percent(
    tmp_path, capsys
):
    parts(tmp_path, 20, 30)
    pairs(tmp_path, count=3)
    assert not take(tmp_path)
    capsys.readouterr()
    run(tmp_path, "mahalanobis")
    assert "38" in capsys.readouterr().out.split()
