"""Small files of the shapes of public logs: headers, labels, times and gaps as there.

Each function writes the files of one set below a folder. Numbers are drawn; nothing is copied.
"""

import gzip
import json
from datetime import UTC, datetime, timedelta

import numpy as np

START = datetime(2020, 3, 9, 10, 14, 33, tzinfo=UTC)


def draw(seed, rows, columns):
    """Return slowly changing numbers around 10."""
    rng = np.random.default_rng(seed)
    return 10 + 0.05 * rng.normal(size=(rows, columns)).cumsum(axis=0) + rng.normal(
        size=(rows, columns)
    )  # fmt: skip


def lines(path, rows, separator=","):
    """Write rows of cells as lines."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "\n".join(separator.join(map(str, row)) for row in rows)
    path.write_text(f"{text}\n", encoding="utf-8")


def stamp(seconds, pattern="%Y-%m-%d %H:%M:%S"):
    return (START + timedelta(seconds=float(seconds))).strftime(pattern)


SKAB = ["Accelerometer1RMS", "Accelerometer2RMS", "Current", "Pressure", "Temperature",
        "Thermocouple", "Voltage", "Volume Flow RateRMS"]  # fmt: skip


def skab(root):
    """Semicolons; every twentieth second is missing; a nominal file without the two labels.

    Faults last from 600 to 1019 s of 1200. In valve2-1 90 s are missing after the fault, in
    other-2 247 s right before it.
    """

    def file(path, seed, seconds, fault=None, hole=(0, 0)):
        times = [s for s in range(seconds) if s % 20 != 19 and not hole[0] <= s < hole[1]]
        rows = draw(seed, len(times), 8)
        rows[:, 4] += 0 if fault else 40  # the nominal day was a hot one
        labels = [[]] * len(times)
        header = ["datetime", *SKAB]
        if fault:
            header += ["anomaly", "changepoint"]
            inside = [fault[0] <= s < fault[1] for s in times]
            rows[inside, 3] += 15
            labels = [[float(i), float(s in fault)] for i, s in zip(inside, times, strict=True)]
        cells = (
            [stamp(s), *row, *label] for s, row, label in zip(times, rows, labels, strict=True)
        )
        lines(root / path, [header, *cells], ";")

    file("anomaly-free/anomaly-free.csv", 0, 2010)
    file("valve1/0.csv", 1, 1200, (600, 1020))
    file("valve1/2.csv", 2, 1200, (600, 1020))
    file("valve1/10.csv", 3, 1200, (600, 1020))
    file("valve2/1.csv", 4, 1200, (600, 1020), hole=(1040, 1130))
    file("other/2.csv", 5, 900, (354, 757), hole=(107, 354))


ALFA = [
    *(f"field.orientation.{x}" for x in "xyz"), *(f"field.angular_velocity.{x}" for x in "xyz"),
    *(f"field.linear_acceleration.{x}" for x in "xyz"), "field.data",
    *(f"field.twist.linear.{x}" for x in "xyz"), *(f"field.twist.angular.{x}" for x in "xyz"),
    "field.alt_error", "field.aspd_error", "field.xtrack_error", "delta_yaw", "delta_pitch",
    "delta_roll", "delta_x", "delta_y", "delta_z", "delta_roll_airspeed",
]  # fmt: skip


def alfa(root):
    """First and last cells empty, no label column without a failure, columns twice in one file."""

    def file(path, seed, rows, fault=None, twice=False):
        names = [name for name in ALFA if fault or name != "field.data"]
        cells = draw(seed, rows, len(names)).astype(object)
        if fault:
            label = names.index("field.data")
            cells[:, label] = 0.0
            cells[fault[0] : fault[1], label] = 1.0
            cells[fault[0] : fault[1], 3:9] += 20
        cells[:4, :9] = ""  # the inertial sensor speaks up late
        cells[-3:, -8:] = ""
        if twice:
            cells, names = np.hstack([cells, cells]), [*names, *(f"{n}_again" for n in names)]
        stamps = [f"2018-07-18 19:{50 + t // 1200:02}:{t / 20 % 60:06.3f}" for t in range(rows)]
        body = ([when, *row] for when, row in zip(stamps, cells, strict=True))
        lines(root / path, [["%time", *names], *body])

    for day in range(6):
        name = f"no_failure/carbonZ_2018-07-{10 + day}-16-37-39_1_no_failure.csv"
        file(name, day, 1000 + 4, twice=day == 0)
    file("engine/carbonZ_2018-07-18-15-53-31_1_engine_failure.csv", 11, 1204, (850, 1204))
    file(
        "engine/carbonZ_2018-07-30-17-20-01_engine_failure_with_emr_traj.csv", 12, 1204, (900, 1190)
    )


ROSA = ["Time", " Force Sensor 1", "Force Sensor 2", "Anomaly Mode", "Desired Speed",
        "D-mode attribute", "Shaft Control Effort", "Actual Speed", "Force Sensor Number",
        *(f"{q} {x}" for q in ("Orient.", "AngVel", "LinAcc.") for x in "xyz"),
        "Mag. x ", "Mag. y", "Mag. z", *(f" Quat. {x}" for x in "wxyz"), "Temp", "Audio",
        "Strain Gage", "Sample Freq", "Force Sensor 1", "D-mode?", "Binary Macro Health Mode",
        "Multi-class Sublevel Mode"]  # fmt: skip


def rosa(root):
    """Milliseconds in uneven steps, a name twice, text between numbers, labels H and A."""

    def file(path, seed, rows, faults, names):
        steps = np.tile([15, 16, 15, 16, 22, 12, 16, 16], rows)[: rows - 1]
        times = 9862 + np.concatenate([[0], steps.cumsum()])
        numbers = draw(seed, rows, len(names))
        body = []
        for i in range(rows):
            state = "A" if any(start <= i < stop for start, stop in faults) else "H"
            if state == "A":
                numbers[i, names.index("Shaft Control Effort")] += 20
            words = {"Time": times[i], "Anomaly Mode": "", "Desired Speed": 300.0,
                     "Force Sensor Number": "Force Sensor 3", "Temp": 26, "D-mode?": state == "A",
                     "Binary Macro Health Mode": state,
                     "Multi-class Sublevel Mode": "D" if state == "A" else "H",
                     "Sample Freq": "" if i == 0 else 62.5}  # fmt: skip
            body.append([words.get(n, numbers[i, k]) for k, n in enumerate(names)])
        lines(root / path, [names, *body])

    twice = [i for i, name in enumerate(ROSA) if name.strip() == "Force Sensor 1"]
    once = [name for i, name in enumerate(ROSA) if i != twice[1]]
    file("Healthy Mode/merged_data104.csv", 0, 800, [], ROSA)
    file("Healthy Mode/merged_data35.csv", 1, 800, [], ROSA)
    file("Manual D Mode/merged_data402.csv", 2, 600, [(0, 195), (388, 600)], once)


def tep(root):
    """No header, blanks, one file transposed; faults from row 160 on."""
    nominal = draw(0, 660, 52)
    faulty = draw(1, 240, 52)
    faulty[160:, 8] += 15
    for name, array in (("d00", nominal[:200].T), ("d00_te", nominal[200:]), ("d05_te", faulty)):
        body = [[f"{value:14.7e}" for value in row] for row in array]
        lines(root / f"{name}.dat", [["", *row] for row in body], "  ")


def uci(root):
    """Blocks of 15 rows behind tabs, the class on a line of its own, two blank lines between."""
    classes = {"lp1": ["normal"] * 21 + ["collision"] * 4 + ["fr_collision"] * 3,
               "lp2": ["normal"] * 20 + ["left_col"] * 3,
               "lp3": ["ok"] * 20 + ["moved"] * 3,
               "lp4": ["normal"] * 24 + ["obstruction"] * 5}  # fmt: skip
    for seed, (name, kinds) in enumerate(classes.items()):
        rng = np.random.default_rng(seed)
        blocks = []
        for kind in kinds:
            shift = 0 if kind in {"normal", "ok"} else 40
            rows = rng.integers(-5, 6, size=(15, 6))
            rows[:, 2] += 60 + shift
            blocks.append("\n".join([kind, *("\t" + "\t".join(map(str, row)) for row in rows)]))
        (root / f"{name}.data").write_text("\n\n\n".join(blocks) + "\n\n\n")


def cwru(root):
    """Variables with the number of the file in their names, columns of one, and a scalar."""
    from scipy.io import savemat

    for number in (97, 98, 100, 105, 118):
        rows = draw(number, 6000 if number < 101 else 2400, 2) * (1 if number < 101 else 4)
        name = f"X{number:03}"
        content = {f"{name}_DE_time": rows[:, :1], f"{name}_FE_time": rows[:, 1:]}
        savemat(root / f"{number}.mat", content | {f"{name}RPM": np.array([[1796]])})


def nab(root):
    """One sensor every five minutes; after row 10149 an hour stands again."""
    rows = draw(0, 22695, 1)[:, 0] + 70
    for start, stop in ((2126, 2693), (3703, 4270), (16057, 16624), (19232, 19799)):
        rows[start:stop] -= 15
    body = [[stamp(300 * i - 3600 * (i >= 10149)), value] for i, value in enumerate(rows)]
    path = root / "machine_temperature_system_failure.csv"
    lines(path, [["timestamp", "value"], *body])


UR3 = ["Num", "Timestamp", *(f"{q}{j}" for j in range(6) for q in ("Current_J", "Temperature_J")),
       *(f"Speed_J{j}" for j in range(6)), "Tool_current", "cycle ", "Robot_ProtectiveStop",
       "grip_lost"]  # fmt: skip
UR3[UR3.index("Temperature_J0")] = "Temperature_T0"


def ur3(root):
    """Decimal commas, eleven empty columns, truth values as labels, a row without values, a gap."""
    seconds = [s + 30 * (s >= 800) for s in range(1600)]
    numbers = draw(0, len(seconds), 19)
    stops = {*range(30, 34), *range(900, 911)}
    grips = {*range(110, 112), *range(1000, 1005)}
    numbers[sorted(stops), 0] += 20
    body = []
    for i, s in enumerate(seconds):
        cells = [f"{value:.6g}".replace(".", ",") for value in numbers[i]]
        stop = str(i in stops)
        if i == 300:
            cells, stop = [""] * len(cells), ""
        when = stamp(s - 0.004 * (i % 800 % 3), "%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"
        body.append([i + 1, when, *cells, i // 25, stop, str(i in grips), *[""] * 11])
    lines(root / "dataset_02052023.csv", [[*UR3, *[""] * 11], *body], ";")


G1 = ["ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow", "WristRoll", "WristPitch",
      "WristYaw", "HandPinky", "HandRing", "HandMiddle", "HandIndex", "HandThumbBend",
      "HandThumbRotation"]  # fmt: skip


def lerobot(root):
    """A parquet file an episode with lists for states and actions, as many rows of both."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    joints = [f"k{side}{joint}" for side in ("Left", "Right") for joint in G1]
    features = {name: {"dtype": "float32", "shape": [26], "names": [joints]}
                for name in ("observation.state", "action")}  # fmt: skip
    info = {
        "codebase_version": "v2.1",
        "robot_type": "Unitree_G1_Inspire",
        "fps": 30,
        "chunks_size": 1000,
        "features": features,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    }
    (root / "meta").mkdir()
    (root / "meta" / "info.json").write_text(json.dumps(info))
    folder = root / "data" / "chunk-000"
    folder.mkdir(parents=True)
    for i in range(10):
        rows = 160 + i
        states = draw(i, rows, 26).astype(np.float32)
        columns = {
            "observation.state": pa.array(states.tolist(), pa.list_(pa.float32(), 26)),
            "action": pa.array((states + 1).tolist(), pa.list_(pa.float32(), 26)),
            "timestamp": pa.array(np.arange(rows) / 30, pa.float32()),
            "frame_index": pa.array(np.arange(rows)),
            "episode_index": pa.array(np.full(rows, i)),
            "task_index": pa.array(np.zeros(rows, int)),
        }
        pq.write_table(pa.table(columns), folder / f"episode_{i:06}.parquet")


PI0 = ["action_norm", "chunk_mse", "action_jerk", "gripper_oscillation", "denoising_curvature",
       "eef_z", "eef_z_vel", "eef_speed_3d", "gripper_qpos_mean", "gripper_qpos_vel",
       "chunk_mse_mmd"]  # fmt: skip


def pi0(root):
    """An object an episode with its outcome; failures run into the limit of 104 rows."""
    for task in (0, 2):
        episodes = []
        for i in range(50):
            success = i % 5 != 4
            length = 40 + i % 7 if success else 104
            rows = draw([task, i], length, len(PI0))
            if not success:
                rows[:, 1] += 2
            steps = [{"t": t, **dict(zip(PI0, row, strict=True))} for t, row in enumerate(rows)]
            facts = {"episode_id": i, "task_id": task, "task_description": "put it there"}
            episodes.append(facts | {"success": success, "length": length, "steps": steps})
        text = "".join(json.dumps(episode) + "\n" for episode in episodes)
        (root / f"task_{task}.jsonl.gz").write_bytes(gzip.compress(text.encode()))


WRITERS = {
    writer.__name__: writer
    for writer in (skab, alfa, rosa, tep, uci, cwru, nab, ur3, lerobot, pi0)
} | {"pi0-failures": pi0}  # fmt: skip
