"""Logs of one's own become a split that every command takes; mistakes are told with their place."""

import csv
import json
import os
import tracemalloc
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from oodd_live import Watchdog
from oodd_logs.importing import import_data
from oodd_logs.marks import read_intervals
from oodd_logs.minari_files import export
from oodd_logs.readers import quantity

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.data.facts import Quantity
from oodd_eval.errors import TrajectoryError, UsageError

ROWS, SENSORS = 60, 3
PARTS = {"train": 4, "calibration": 5}
TESTS = ("nominal", "clog", "fog")


def episode(seed, onset=None):
    """Observations and actions of a pump; from the onset on it runs hot."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(ROWS + 1, SENSORS)).cumsum(axis=0) * 0.1
    if onset is not None:
        rows[onset:, 0] += 5.0
    return rows.astype(np.float32), rng.uniform(-1, 1, size=(ROWS, 1)).astype(np.float32)


def parts():
    """Names of the places with names, arrays and onsets of their episodes."""
    for name, count in PARTS.items():
        yield name, [(f"run-{i}", *episode([len(name), i]), None) for i in range(count)]
    for k, name in enumerate(TESTS):
        onsets = [None if k == 0 else 20 + i + k for i in range(3)]
        yield f"test/{name}", [(f"run-{i}", *episode(i, o), o) for i, o in enumerate(onsets)]


def as_numpy(root):
    for part, episodes in parts():
        (root / part).mkdir(parents=True)
        for name, rows, actions, onset in episodes:
            known = {} if onset is None else {"onset": onset}
            arrays = {"observations": rows, "actions": actions, "rewards": np.ones(ROWS)}
            np.savez_compressed(root / part / f"{name}.npz", **arrays, **known)


def as_csv(root):
    for part, episodes in parts():
        (root / part).mkdir(parents=True)
        onsets = [(f"{name}.csv", onset) for name, _, _, onset in episodes if onset is not None]
        for name, rows, actions, _ in episodes:
            commands = [*actions[:, 0].tolist(), ""]
            with (root / part / f"{name}.csv").open("w", newline="") as file:
                write = csv.writer(file).writerow
                write(["time", "obs:pressure[bar]", "obs:flow", "obs:heat[°C]", "action:valve",
                       "reward"])  # fmt: skip
                for t, (row, command) in enumerate(zip(rows.tolist(), commands, strict=True)):
                    write([0.1 * t, *row, command, "" if command == "" else 1])
        if onsets:
            with (root / part / "onsets.csv").open("w", newline="") as file:
                csv.writer(file).writerows([("file", "onset"), *onsets])


def as_hdf5(root):
    for part, episodes in parts():
        (root / part).parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(root / f"{part}.h5", "w") as file:
            for name, rows, actions, onset in episodes:
                group = file.create_group(name)
                group["observations"], group["actions"] = rows, actions
                group["rewards"] = np.ones(ROWS)
                if onset is not None:
                    group.attrs["onset"] = onset


MAKE = {"numpy": as_numpy, "csv": as_csv, "hdf5": as_hdf5}
NAMED = tuple(map(quantity, ("pressure[bar]", "flow", "heat[°C]")))


def arguments(root, form):
    end = ".h5" if form == "hdf5" else ""
    return {"form": form, "train": root / f"train{end}", "calibration": root / f"calibration{end}",
            "test": root / "test"}  # fmt: skip


def imported(root, form, name="plant", environment="pump", **more):
    named = {} if form == "csv" else {"sensors": NAMED, "actions": [Quantity("valve", "1")]}
    given = {"groups": {"fog": "sensor"}, "output": root / name, **named, **more}
    return import_data(name, environment, **(arguments(root, form) | given))


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    root = tmp_path_factory.mktemp("logs")
    as_csv(root)
    return imported(root, "csv")


def test_an_import_holds_what_was_logged(split):
    data = split.environment("pump")
    assert split.groups == {"clog": "dynamics", "fog": "sensor"}
    assert (data.sensors, [q.name for q in data.actions]) == (NAMED, ["valve"])
    for part, episodes in parts():
        own = {"train": data.train, "calibration": data.calibration, "test/nominal": data.twins}
        found = own[part] if part in own else data.anomalous(part.removeprefix("test/"))
        for one, (_, rows, actions, _) in zip(found, episodes, strict=True):
            assert one.observations == pytest.approx(rows, abs=1e-6)
            assert one.actions == pytest.approx(actions, abs=1e-6)
        assert found.returns.tolist() == [ROWS] * len(episodes)
    fog = data.anomalous("fog")
    assert fog.onsets.tolist() == fog.effects.tolist() == [22, 23, 24]


def test_formats_give_the_same_bytes(tmp_path):
    digests = set()
    for form, make in MAKE.items():
        make(tmp_path / form)
        digests.add(imported(tmp_path / form, form).digest)
    assert len(digests) == 1


def test_a_further_environment_joins_a_split_and_is_replaced_where_that_is_asked_for(tmp_path):
    as_numpy(tmp_path)
    one = imported(tmp_path, "numpy", environment="drain").digest
    both = imported(tmp_path, "numpy")
    assert both.environments == ("drain", "pump")
    assert both.digest != one
    assert all(check.ok for check in both.verify())
    with pytest.raises(UsageError, match="has an environment 'drain' already"):
        imported(tmp_path, "numpy", environment="drain")
    assert imported(tmp_path, "numpy", replace=True).digest == both.digest
    fewer = imported(tmp_path, "numpy", replace=True, test=None, groups={})
    assert fewer.environments == ("drain", "pump")
    assert not fewer.environment("pump").anomalies
    assert fewer.environment("drain").anomalies
    assert all(check.ok for check in fewer.verify())


def test_without_tests_it_is_a_split_to_watch_with(tmp_path, capsys):
    as_numpy(tmp_path)
    split = imported(tmp_path, "numpy", test=None, groups={})
    data = split.environment("pump")
    assert (len(data.twins), data.anomalies) == (0, ())
    assert main(["data", "info", str(split.path)]) == 0
    assert main(["data", "verify", str(split.path)]) == 0
    assert [export(split, tmp_path / "out", environments=["pump"])[-1]] == [
        "oodd/plant/pump/calibration-v0"
    ]
    run = ["run", "--detector", "range", "--env", "all", "--split", str(split.path)]
    assert main([*run, "--output", str(tmp_path / "r")]) == 4
    assert "no anomalous episodes of pump" in capsys.readouterr().err
    nominal = [*data.train, *data.calibration]
    watchdog = Watchdog.fit("mahalanobis", nominal, data.calibration, 0.5)
    assert watchdog.update(data.train[0].observations[0]).t == 0


def test_actions_may_be_unknown_or_numbers(tmp_path):
    for part, episodes in parts():
        for kind in ("none", "discrete"):
            (tmp_path / kind / part).mkdir(parents=True)
            for name, rows, actions, onset in episodes:
                more = {} if onset is None else {"onset": onset}
                if kind == "discrete":
                    more["actions"] = (actions[:, 0] > 0).astype(int) * 2
                np.savez(tmp_path / kind / part / f"{name}.npz", observations=rows, **more)
    given = arguments(tmp_path / "none", "numpy")
    data = import_data("plant", "pump", output=tmp_path / "a", **given).environment("pump")
    assert data.train[0].action_dim == 0
    assert data.sensors[2] == Quantity("sensor 2", "1")
    given = arguments(tmp_path / "discrete", "numpy")
    lines = []
    import_data("plant", "pump", output=tmp_path / "amounts", report=lines.append, **given)
    assert any("--discrete 3" in line for line in lines)
    with pytest.raises(TrajectoryError, match=r"run-0.npz: action \d+ is 2, .* from 0 to 1"):
        import_data("plant", "pump", discrete=2, output=tmp_path / "b", **given)
    split = import_data("plant", "pump", discrete=3, output=tmp_path / "b", **given)
    data = split.environment("pump")
    assert data.discrete
    assert data.train[0].actions.sum(axis=0)[1] == 0
    assert set(data.train[0].actions.sum(axis=1)) == {1.0}


@pytest.mark.parametrize("environment", ["cartpole", "hopper"])
def test_an_exported_split_comes_back_as_it_was(tiny_split, tmp_path, environment):
    split = load_split(tiny_split)
    export(split, tmp_path, environments=[environment])
    place = tmp_path / "oodd" / "tiny" / environment
    back = import_data(
        "back", "other", form="minari", train=place / "train-v0",
        calibration=place / "calibration-v0", test=place, output=tmp_path / "back",
    )  # fmt: skip
    then, now = (s.manifest["environments"] for s in (split, back))
    assert now["other"]["groups"].keys() == then[environment]["groups"].keys()
    for name in ("train", "calibration", "test/nominal"):
        assert now["other"]["groups"][name] == then[environment]["groups"][name]
    was, is_now = split.environment(environment), back.environment("other")
    columns = [[(q.name, q.unit) for q in (*d.sensors, *d.actions)] for d in (was, is_now)]
    assert columns[0] == columns[1]
    assert is_now.discrete == (environment == "cartpole")
    assert is_now.anomalous("iid").parameters == was.anomalous("iid").parameters


def test_a_dataset_that_minari_collected_is_read(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    gymnasium = pytest.importorskip("gymnasium")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    from minari.data_collector import EpisodeBuffer

    rng = np.random.default_rng(0)
    for part in ("train", "calibration"):
        episodes = [
            EpisodeBuffer(
                id=i, observations=rng.normal(size=(n + 1, 4)).astype(np.float32),
                actions=rng.integers(0, 2, n), rewards=[1.0] * n,
                terminations=[False] * (n - 1) + [True], truncations=[False] * n,
            )
            for i, n in enumerate((12, 7, 30))
        ]  # fmt: skip
        minari.create_dataset_from_buffers(
            f"own/{part}-v0", episodes, env=gymnasium.make("CartPole-v1"),
            algorithm_name="random", author="me", author_email="me@example.org",
            code_permalink="https://example.org", description="a test",
            eval_env="CartPole-v1",
        )  # fmt: skip

    def read(name):
        parts = {part: tmp_path / "own" / f"{part}-v0" for part in ("train", "calibration")}
        return import_data(name, "cart", form="minari", output=tmp_path / name, **parts)

    data = read("carts").environment("cart")
    theirs = minari.load_dataset("own/train-v0")
    for mine, other in zip(data.train, theirs.iterate_episodes(), strict=True):
        assert mine.observations == pytest.approx(other.observations)
        assert mine.actions.argmax(axis=1).tolist() == other.actions.tolist()
    assert data.train.terminated.all()
    file = tmp_path / "own" / "train-v0" / "data" / "metadata.json"
    facts = json.loads(file.read_text()) | {"observation_space": '{"type": "Dict"}'}
    file.write_text(json.dumps(facts))
    with pytest.raises(TrajectoryError, match="observations are Dict and actions Discrete"):
        read("again")


def rewritten(path, **arrays):
    with np.load(path) as stored:
        kept = {name: stored[name] for name in stored.files}
    np.savez(path, **{k: v for k, v in (kept | arrays).items() if v is not None})


def changed(place, **arrays):
    return lambda root: rewritten(root / place / "run-1.npz", **arrays)


HUGE = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000, 3), }"


def packed(content, method=zipfile.ZIP_STORED):
    def spoil(root):
        with zipfile.ZipFile(root / "train" / "run-1.npz", "w", method) as archive:
            archive.writestr("observations.npy", content)

    return spoil


def gap():
    rows = episode(0)[0]
    rows[7, 1] = np.nan
    return rows


BROKEN = [
    (changed("train", observations=gap()), r"run-1.npz, row 7, column 'obs:sensor 1' is missing"),
    (packed(b"\x93NUMPY\x01\x00" + len(HUGE).to_bytes(2, "little") + HUGE),
     r"run-1.npz, observations: arrays take 12000000000 bytes"),
    (packed(b"anything", zipfile.ZIP_LZMA),
     r"run-1.npz cannot be read: .* neither stored nor deflated"),
    (changed("train", observations=np.array([[{}]], dtype=object)),
     r"run-1.npz, observations has dtype \|O"),
    (changed("train", observations=None), r"run-1.npz: has the columns .* none is called obs:"),
    (changed("train", observations=np.ones((61, 2))), r"run-1.npz has 2 sensors, .*lacks sensor 2"),
    (changed("train", actions=np.ones((59, 1))), r"run-1.npz: actions has shape \(59, 1\)"),
    (changed("train", observations=np.ones((1, 3)), actions=np.ones((1, 1)), rewards=np.ones(1)),
     r"has 1 observation, expected at least 2"),
    (changed("train", rewards=np.ones(3)), r"rewards has shape \(3,\)"),
    (lambda r: (r / "test" / "fog" / "run-1.npz").unlink(), r"'run-1' is missing"),
    (lambda r: (r / "test" / "nominal" / "run-1.npz").unlink(), r"'run-1' has no nominal twin"),
    (changed("test/fog", onset=None), r"run-1.npz has no onset"),
    (changed("test/fog", onset=61), r"row 61, expected 0 to 60"),
    (changed("test/fog", onset=np.arange(3)), r"run-1.npz: onset is .*one whole number"),
    (changed("test/fog", onset=np.nan), r"run-1.npz: onset is .*one whole number"),
    (changed("test/fog", onset=2.0**70), r"run-1.npz: onset is .*one whole number"),
    (changed("test/fog", observations=episode(1)[0]), r"equals its twin"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), BROKEN)
def test_what_is_wrong_with_an_episode_is_said_with_its_file(tmp_path, spoil, message):
    as_numpy(tmp_path)
    spoil(tmp_path)
    with pytest.raises((TrajectoryError, UsageError), match=message):
        imported(tmp_path, "numpy")
    assert not (tmp_path / "plant" / "manifest.json").exists()
    assert not [*(tmp_path / "plant").glob("*.h5")]


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (5, "0.4,1,x,3,0,1", r"row 3, column 'obs:flow' is 'x'"),
        (5, "0.4,1,2,3,,1", r"row 3, column 'action:valve' is missing"),
        (5, "0.4", r"line 5"),
        (5, "0.4," * 2**18, r"more than 1048576 characters"),
        (1, "time,obs:a,obs:b,obs:c,action:d,reward", r"lacks pressure\[bar\]"),
    ],
)
def test_what_is_wrong_with_a_table_is_said_with_its_line(tmp_path, line, text, message):
    as_csv(tmp_path)
    path = tmp_path / "train" / "run-1.csv"
    lines = path.read_text().splitlines()
    lines[line - 1] = text
    path.write_text("\n".join(lines))
    with pytest.raises(TrajectoryError, match=message):
        imported(tmp_path, "csv")


def test_a_long_table_takes_little_memory(tmp_path):
    as_csv(tmp_path)
    path = tmp_path / "train" / "run-1.csv"
    header = path.read_text().splitlines()[0]
    path.write_text("\n".join([header, *["12" + ",34" * header.count(",")] * 120_000]))
    tracemalloc.start()
    imported(tmp_path, "csv")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10 * path.stat().st_size


def in_hdf5(part, change):
    def spoil(root):
        with h5py.File(root / f"{part}.h5", "a") as file:
            change(file)

    return spoil


def pipe(root):
    (root / "train.h5").unlink()
    os.mkfifo(root / "train.h5")


def test_onsets_are_rows_also_where_they_are_written_as_floats(tmp_path):
    as_csv(tmp_path)
    onsets = tmp_path / "test" / "fog" / "onsets.csv"
    rows = [line.split(",") for line in onsets.read_text().splitlines()]
    expected = [(name, int(row), None, "") for name, row in rows[1:]]
    for written in ("{}", "{}.0", "{}.000"):
        lines = [f"{name},{written.format(row)}" for name, row in rows[1:]]
        onsets.write_text("\n".join(["file,onset", *lines]))
        intervals = read_intervals(onsets)
        assert intervals == expected
        assert all(isinstance(start, int) for _, start, _, _ in intervals)
    for wrong in ("3.5", "-1.0", ".0", "3.0e1", "3.01", ""):
        onsets.write_text(f"file,onset\nrun-0.csv,{wrong}")
        with pytest.raises(TrajectoryError, match=r"onsets\.csv, line 2"):
            read_intervals(onsets)
    # Beside a start a number with a point is a time.
    onsets.write_text("file,start,stop\nrun-0.csv,3.0,")
    assert read_intervals(onsets) == [("run-0.csv", 3.0, None, "")]


@pytest.mark.parametrize(
    ("form", "spoil", "message"),
    [
        ("csv", lambda r: (r / "test" / "fog" / "onsets.csv").write_text("file,onset\na.csv,soon"),
         "onsets.csv, line 2"),
        ("hdf5", in_hdf5("train", lambda file: file.update(
            leak=h5py.ExternalLink("calibration.h5", "run-0"))),
         "holds 'leak', which points elsewhere: refused"),
        ("hdf5", in_hdf5("test/fog", lambda file: file["run-1"].attrs.update(onset=[1, 2])),
         "onset is no single value"),
        ("hdf5", pipe, "train.h5 is no plain file"),
    ],
    ids=["onsets", "link", "array", "pipe"],
)  # fmt: skip
def test_what_is_wrong_with_a_file_is_said(tmp_path, form, spoil, message):
    MAKE[form](tmp_path)
    spoil(tmp_path)
    with pytest.raises(TrajectoryError, match=message):
        imported(tmp_path, form)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"environment": "hopper"}, "the benchmark's environment"),
        ({"name": "mini"}, "the benchmark's split"),
        ({"environment": "../x"}, "cannot be the name"),
        ({"groups": {"smog": "sensor"}}, "did you mean 'fog'"),
        ({"groups": {"fog": "weather"}}, "unknown group 'weather'"),
        ({"sensors": NAMED[:2]}, "there are 3 sensors"),
        ({"sensors": NAMED[:1] * 3}, "as many different names"),
        ({"form": "npz"}, "unknown format 'npz'"),
        ({"calibration": "nowhere"}, "'nowhere' does not exist"),
        ({"test": "train"}, "expected a part 'nominal'"),
    ],
)
def test_a_wrong_request_is_refused_with_what_to_do(tmp_path, more, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    as_numpy(tmp_path)
    paths = {k: Path(v) if k in {"calibration", "test"} else v for k, v in more.items()}
    with pytest.raises(UsageError, match=message):
        imported(tmp_path, **({"form": "numpy"} | paths))


def test_the_command_imports_and_says_where_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "splits"))
    as_numpy(tmp_path)
    command = [
        "data", "import", "plant", "--env", "pump", "--format", "numpy",
        "--train", f"{tmp_path}/train", "--calibration", f"{tmp_path}/calibration",
        "--test", f"{tmp_path}/test", "--sensors", "pressure[bar],flow,heat[K]",
        "--group", "fog=sensor",
    ]  # fmt: skip
    assert main(command) == 0
    assert "writing test/fog" in capsys.readouterr().out
    assert load_split("plant").environment("pump").sensors[2] == Quantity("heat", "K")
    assert main(command) == 4
    assert "has an environment 'pump' already" in capsys.readouterr().err
    assert main([*command, "--replace"]) == 0
    assert "oodd-eval run --detector" in capsys.readouterr().out
    assert main(["data", "build", "plant", "--env", "cartpole", "--train", "1", "--calibration",
                 "1", "--test", "1", "--seed-base", "77", "--cap", "60"]) == 4  # fmt: skip
