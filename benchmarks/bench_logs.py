"""What it takes to read and to import logs: processor seconds beside a plain loop, and peak memory.

``python benchmarks/bench_logs.py [--files 1000] [--rows 10000000] [--json 15]``

The limit is a plain loop over the rows of `csv.reader` with `float` for every cell, which was the
whole reader before there were recipes. It and the reader of CSV files take turns, file by file, in
one process; files are links to 20 different ones. An import runs in a process of its own, whose
peak of memory is measured. The import before there were recipes took 1.8 times the seconds of the
plain loop over its files (200 of them, measured in turns), which is the limit of today's; of few
files, most is the start of the program. A recording of 10^7 rows and 20 columns in one Parquet file
is read in windows, and imported. Lines of JSON, of one recording and of episodes of ten steps, are
inspected; the limit is `json.loads` of every line. Exit code 1 where a ratio is above its limit, or
memory above 500 MB for the files, 1 GB for the recording.
"""

import argparse
import csv
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from oodd_logs.readers import readers

DIFFERENT, ROWS, COLUMNS = 20, 5000, 8
WIDE, WINDOW = 20, 600
READING, IMPORTING = 1.0, 1.8  # of the plain loop's seconds
INSPECTING = 25.0  # of the seconds of json.loads
FILES_MB, RECORDING_MB = 500, 1000

IMPORT = """
import sys
from oodd_eval.cli.main import main
assert main(sys.argv[1:]) == 0
"""
INSPECT = """
import sys
from oodd_eval.cli.main import main
sys.stdout = open("/dev/null", "w")
assert main(["data", "inspect", sys.argv[1]]) == 0
sys.stdout = sys.__stdout__
"""
READ = """
import sys
from pathlib import Path
from oodd_logs.readers import readers
(recording,) = readers()["parquet"].read(Path(sys.argv[1]))
topic = recording.topics[""]
total = 0.0
for start in range(0, topic.rows, {window}):
    cells = topic.read(topic.names, start, min(start + {window}, topic.rows))
    total += cells["x0"].sum()
print(total)
"""


def write_files(folder, count):
    """Write CSV files of smooth sensors in turn: links to a few different ones."""
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True)
    for i in range(count):
        path = folder / f"run-{i:04d}.csv"
        if i >= DIFFERENT:
            os.link(folder / f"run-{i % DIFFERENT:04d}.csv", path)
            continue
        values = np.column_stack([np.arange(ROWS) / 100, rng.normal(size=(ROWS, COLUMNS - 1))])
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["t", *(f"x{k}" for k in range(COLUMNS - 1))])
            writer.writerows(values.tolist())


def write_recording(path, rows):
    """Write one recording in row groups of a million rows."""
    rng = np.random.default_rng(0)
    schema = pa.schema([("t", pa.float64()), *((f"x{k}", pa.float32()) for k in range(WIDE))])
    with pq.ParquetWriter(path, schema) as writer:
        for start in range(0, rows, 10**6):
            count = min(10**6, rows - start)
            noise = rng.normal(size=(WIDE, count)).round(2).astype("f4")
            columns = [np.arange(start, start + count) / 100, *noise]
            writer.write_table(pa.table(columns, schema=schema))


def write_json(path, megabytes, steps):
    """Write lines of JSON: rows with a stamp, a pose and 20 numbers, or episodes of some steps."""
    rng = np.random.default_rng(0)
    with path.open("w") as file:
        for i in itertools.count():
            if file.tell() > megabytes * 10**6:
                break
            if steps:
                values = rng.normal(size=(steps, 30)).round(4).tolist()
                row = {"task": i % 5, "steps": [{"t": t, "q": q} for t, q in enumerate(values)]}
            else:
                row = {"header": {"stamp": {"nanosec": 0, "sec": i}, "frame_id": "base"}}
                row["pose"] = {"x": i / 7, "q": [0.1, 0.2, 0.3, i % 5]}
                row |= {f"s{k}": x for k, x in enumerate(rng.normal(size=20).round(5).tolist())}
            file.write(json.dumps(row) + "\n")


def load_json(path):
    """Read every line of JSON and keep nothing."""
    with path.open() as file:
        return sum(len(json.loads(line)) for line in file)


def plain(path):
    """Read a file as directly as Python can."""
    with path.open(newline="") as file:
        rows = csv.reader(file)
        next(rows)
        return np.array([[float(cell) for cell in row] for row in rows])


def read(path):
    """Read a file as an import does."""
    (recording,) = readers()["csv"].read(path)
    topic = recording.topics[""]
    return np.column_stack([*topic.read(topic.names, 0, topic.rows).values()])


def timed(function, path):
    start = time.process_time()
    values = function(path)
    return time.process_time() - start, values


def child(code, *arguments):
    """Run a program; return its processor seconds and its peak of memory in MB.

    Of a process that ended, Linux says the larger of its peak and of that of its parent.
    """
    peak = "print(*[x for x in open('/proc/self/status') if x.startswith('VmHWM')])"
    command = [sys.executable, "-c", f"{code}\n{peak}", *arguments]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, int(done.stdout.split()[-2]) / 1000


def recipe(path, name, form, more=""):
    path.write_text(f"""split = "{name}"
environment = "{name}"
sensors = ["x*"]
time = "t"
rate = 100
{more}
[read]
format = "{form}"
[nominal]
files = ["*.{form}"]
parts = [0.4, 0.3, 0.3]
""")
    return path


def imported(folder, name, form, more=""):
    """Import a folder by a recipe; return seconds and peak memory."""
    file = recipe(folder / f"{name}.toml", name, form, more)
    output = folder / "split"
    return child(IMPORT, "data", "import", str(file), "--output", str(output))


def measure_json(folder, megabytes):
    """Print what inspecting lines of JSON takes; return what is beyond its limit."""
    beyond = []
    for what, steps in (("rows", 0), ("episodes of 10 steps", 10)):
        path = folder / f"{steps}.jsonl"
        write_json(path, megabytes, steps)
        loading, _ = timed(load_json, path)
        taken, memory = child(INSPECT, str(path))
        ratio = taken / loading
        figures = f"{taken:.1f} s, {ratio:.1f} of json.loads; peak {memory:.0f} MB"
        print(f"inspecting {megabytes} MB of JSON, {what}: {figures}")
        if ratio > INSPECTING:
            beyond.append(f"inspection of JSON, {what}")
    return beyond


def measure(folder, files, rows):
    """Print all figures; return what is beyond its limit."""
    beyond = []
    write_files(folder / "files", files)
    seconds = np.zeros(2)
    for path in sorted((folder / "files").iterdir()):
        one, expected = timed(plain, path)
        other, values = timed(read, path)
        assert np.array_equal(expected, values)
        seconds += one, other
    ratio = seconds[1] / seconds[0]
    print(f"reading {files} CSV files: {seconds[1]:.1f} s, {ratio:.2f} of a plain loop's")
    if ratio > READING:
        beyond.append("reading of CSV files")
    taken, memory = imported(folder / "files", "files", "csv")
    ratio = taken / seconds[0]
    print(f"importing them: {taken:.1f} s, {ratio:.2f} of a plain loop's; peak {memory:.0f} MB")
    if ratio > IMPORTING or memory > FILES_MB:
        beyond.append("import of CSV files")
    (folder / "recording").mkdir()
    path = folder / "recording" / "run.parquet"
    write_recording(path, rows)
    for what, (taken, memory) in (
        ("reading", child(READ.format(window=WINDOW), str(path))),
        ("importing", imported(path.parent, "recording", "parquet", f"window = {WINDOW}")),
    ):
        print(f"{what} {rows} rows in windows of {WINDOW}: {taken:.1f} s; peak {memory:.0f} MB")
        if memory > RECORDING_MB:
            beyond.append(f"{what} of a recording")
    return beyond


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--rows", type=int, default=10**7)
    parser.add_argument("--json", type=int, default=15, help="megabytes")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        beyond = measure_json(Path(folder), options.json)
        beyond += measure(Path(folder), options.files, options.rows)
    for what in beyond:
        print(f"beyond its limit: {what}")
    return int(bool(beyond))


if __name__ == "__main__":
    sys.exit(main())
