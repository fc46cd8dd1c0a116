"""``oodd-eval calibrate`` in one command: on every kind of logs, and what it prints."""

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from helpers_logs import log_parts, write_log_split, write_table
from mcap.writer import Writer

from oodd_eval.cli.main import main
from oodd_eval.data.facts import LogFacts

ROWS = 30


def signal(i, rows=ROWS):
    """A residual that is at most 1, and at row 20 its number over 100."""
    values = np.sin(np.arange(rows) + i) / 2
    values[20] = 1 + i / 100
    return values


def write_csv(folder, numbers, **columns):
    for i in numbers:
        time = [f"{0.02 * t:.2f}" for t in range(ROWS)]
        facts = {name: [value(i)] * ROWS for name, value in columns.items()}
        if "fault" in facts:  # a label of rows
            facts["fault"] = [int(t > 18 and fault) for t, fault in enumerate(facts["fault"])]
        table = {"t[s]": time, "speed": np.cos(np.arange(ROWS) + i).round(4).tolist()}
        write_table(folder / f"run-{i:02}.csv", table | {"residual[m]": signal(i).tolist()} | facts)


def write_ulog(path, i):
    """A topic at 5 Hz between rows of a fast one."""

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    text = b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 5)
    text += message("B", bytes(40))
    for name in (b"imu:uint64_t timestamp;float x;", b"innovation:uint64_t timestamp;float hvel;"):
        text += message("F", name)
    for number, name in enumerate((b"imu", b"innovation")):
        text += message("A", struct.pack("<BH", 0, number) + name)
    for t in range(40 * ROWS):
        stamp = 1_000_000 + 5_000 * t
        text += message("D", struct.pack("<HQf", 0, stamp, np.cos(t)))
        if t % 40 == 0:
            text += message("D", struct.pack("<HQf", 1, stamp, signal(i)[t // 40]))
    path.write_bytes(text)


def write_mcap(path, i):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("plain", "jsonschema", b"{}")
        channel = writer.register_channel("/monitor", "json", schema)
        for t, value in enumerate(signal(i)):
            data = json.dumps({"residual": value, "mode": "auto"}).encode()
            writer.add_message(channel, 10**8 * t, data, 10**8 * t)
        writer.finish()


def write_lerobot(root, numbers):
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    features = {"observation.state": {"dtype": "float32", "shape": [2],
                                      "names": ["chunk_mse", "grip"]}}  # fmt: skip
    path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info = {"codebase_version": "v2.1", "fps": 30, "chunks_size": 1000, "features": features}
    folder = root / "data" / "chunk-000"
    folder.mkdir(parents=True)
    (root / "meta").mkdir()
    (root / "meta" / "info.json").write_text(json.dumps(info | {"data_path": path}))
    for i in numbers:
        states = np.stack([signal(i), np.cos(np.arange(ROWS) + i)], axis=1)
        columns = {
            "observation.state": pa.array(states.tolist(), pa.list_(pa.float32(), 2)),
            "timestamp": pa.array(np.arange(ROWS) / 30, pa.float32()),
            "frame_index": pa.array(np.arange(ROWS)),
            "episode_index": pa.array(np.full(ROWS, i)),
            "task_index": pa.array(np.zeros(ROWS, int)),
        }
        pq.write_table(pa.table(columns), folder / f"episode_{i:06}.parquet")


@pytest.fixture
def run(capfd, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")

    def calibrate(*arguments, code=0):
        capfd.readouterr()
        assert main(["calibrate", *map(str, arguments)]) == code
        written = capfd.readouterr()
        return written.err if code else written.out

    return calibrate


FORMS = {
    "csv": (lambda f: write_csv(f, range(20)), "residual"),
    "ulog": (lambda f: [write_ulog(f / f"{i:02}.ulg", i) for i in range(20)], "innovation.hvel"),
    "mcap": (lambda f: [write_mcap(f / f"{i:02}.mcap", i) for i in range(20)], "/monitor.residual"),
    "lerobot": (lambda f: write_lerobot(f, range(20)), "chunk_mse"),
}


@pytest.mark.parametrize("form", FORMS)
def test_one_command_on_every_form_of_logs_and_on_the_recipe_of_inspect(form, run, tmp_path):
    """Of 20 largest values, 1 to 1.19, the 19th is exceeded by at most 10 %."""
    write, column = FORMS[form]
    (tmp_path / "logs").mkdir()
    write(tmp_path / "logs")
    first = run("logs", "--score", column, "--level", 10).splitlines()[0]
    name, _, threshold = first.removesuffix(" m").partition(" > ")
    assert name == column
    assert 1.18 <= float(threshold) < 1.180002
    assert main(["data", "inspect", "logs", "--recipe", "arm.toml", "-q"]) == 0
    text = run("arm.toml", "--score", column, "--level", 10)
    if form == "ulog":  # which the recipe cuts, and most windows have no peak
        assert "At most 10 % of windows of further healthy logs alarm. Logs that no window" in text
    else:
        assert text.splitlines()[0] == first
    if form == "csv":
        assert run("logs", "--recipe", "arm.toml", "--score", column, "--level", 10).startswith(
            first
        )


def test_the_text_says_what_a_threshold_is_worth(run, tmp_path):
    write_csv(tmp_path / "logs", range(22), fault=lambda i: i >= 20)
    text = run("logs", "--score", "residual")
    first, *sentences = text.splitlines()
    assert first == "residual > 1.19 m"
    assert sentences[0] == "At most 5 % of further healthy logs alarm."
    # The largest of 20: one less the 20th order statistic has the law Beta(1, 20).
    low, high = (100 * (1 - (1 - p) ** (1 / 20)) for p in (0.025, 0.975))
    assert f"{low:.2g} to {high:.2g} % (95 % interval, from 20 healthy logs)" in sentences[1]
    assert sentences[2] == "1 % takes 99 healthy logs, 79 more."
    assert "stops at 1.19, and lets 4.76 % (1/21) of further healthy logs trip" in sentences[3]
    assert (
        "follow the order of the logs" in sentences[4]
    )  # as numbers of the logs are its largest values
    assert sentences[5] == (
        "Of 2 logs with fault: 2 alarm once it began, by a median delay of 1 rows; 0 never."
    )
    assert run("logs", "--score", "residual", "-q") == f"{first}\n"


def test_signs_holds_and_formulas(run, tmp_path):
    write_csv(tmp_path / "logs", range(40))
    least = float(run("logs", "--score", "-speed", "-q").split()[2])
    speeds = [-np.cos(np.arange(ROWS) + i).round(4).min() for i in range(40)]
    assert least == pytest.approx(max(speeds))
    assert run("logs", "--score", "|residual|", "-q").startswith("|residual| > 1.38 m")
    held = run("logs", "--score", "abs(residual)", "--hold", 2)
    assert held.splitlines()[0].endswith(" m in 2 scores in a row")
    assert float(held.split()[2]) < 1
    text = run("logs", "--score", "residual", "--alarm", "cusum")
    assert text.startswith("cusum(residual) > ")
    values = np.concatenate([signal(i) for i in range(0, 40, 2)])
    factor, mean = f"{0.01 / values.std():.6g}", f"{values.mean():.6g}"
    assert f"S = max(0, S + {factor} * (residual - {mean}) - 0.0018)" in text
    text = run("logs", "--score", "residual", "--alarm", "ewma")
    assert "ewma: m = m + 0.2 * (residual - m), from the first score on." in text


def test_a_threshold_for_each_group_stands_before_the_pooled_one(run, tmp_path):
    write_csv(tmp_path / "logs", range(30), airframe=lambda i: "delta" if i < 19 else "quad")
    lines = run("logs", "--score", "residual", "--per", "airframe").splitlines()
    assert lines[0].startswith("delta: residual > 1.18 m (pooled, 0 of its 19 healthy logs alarm")
    assert lines[1].startswith(
        "quad: 11 healthy logs, too few for 5 %: the alarm threshold needs 19, 8 more"
    )
    assert "(pooled, 0 of its 11 healthy logs alarm: 0 to 28 %)" in lines[1]
    assert lines[2] == "residual > 1.29 m"
    refused = run("logs", "--score", "residual", "--per", "owner", code=4)
    assert "no healthy log has a field or column 'owner'" in refused


def test_json_has_everything(run, tmp_path):
    write_csv(tmp_path / "logs", range(20), airframe=lambda i: "delta" if i < 19 else "quad")
    content = json.loads(run("logs", "--score", "residual", "--per", "airframe", "--json"))
    assert content["threshold"] == 1.19
    assert (content["unit"], content["level"], content["needed"]) == ("m", 0.05, 0)
    assert content["sweep"] == [1.19, 1 / 21]
    assert content["groups"]["delta"]["calibration"]["threshold"] == 1.18
    assert content["groups"]["quad"]["calibration"] is None
    assert content["read"] == ["Nothing says that a log is anomalous: all count as healthy."]


def test_what_is_no_score_gets_a_sentence(run, tmp_path):
    def flag(i):
        return int(i == 3)

    facts = {"mode": lambda _: "auto", "fixed": lambda _: 2, "tripped": flag, "none": lambda _: ""}
    write_csv(tmp_path / "logs", range(20), **facts)

    def refused(column):
        return run("logs", "--score", column, code=4)

    assert "is 0 or 1 in all rows" in refused("tripped")
    assert "run --detector flag:NAME` judges it" in refused("tripped")
    assert "column 'mode' is 'auto', expected a number" in refused("mode")
    assert "A score is a column of numbers" in refused("mode")
    assert "is 2 in all rows of 20 healthy logs" in refused("fixed")
    assert "the score has no value there" in refused("none")
    assert "did you mean 'residual'" in refused("residul")
    assert "names 2, residual and tripped: expected one" in refused("*r*i*d*")
    few = run("logs/run-03.csv", "--score", "residual", code=4)
    assert "1 healthy log, too few for 5 %: the alarm threshold needs 19, 18 more" in few
    assert "these allow 50 % (--level 50)" in few


def test_logs_without_a_value_are_left_out_by_name(run, tmp_path):
    write_csv(tmp_path / "logs", range(20))
    for i in (4, 5):
        table = {"speed": np.cos(np.arange(ROWS) + i / 9).tolist(), "residual[m]": [""] * ROWS}
        write_table(tmp_path / "logs" / f"run-{i:02}.csv", {"t[s]": range(ROWS)} | table)
    text = run("logs", "--score", "residual", "--level", 10)
    assert "from 18 healthy logs" in text
    assert "Left out, as the score has no value there: run-04 and run-05." in text


def test_of_a_state_and_an_action_with_one_name_either_can_be_named(run, tmp_path):
    for i in range(20):
        columns = {"obs:grip": signal(i).tolist(), "action:grip": (2 * signal(i)).tolist()}
        write_table(tmp_path / "logs" / f"run-{i:02}.csv", columns)
    message = run("logs", "--score", "grip", code=4)
    assert "two sensors named 'grip': name one of obs:grip and action:grip" in message
    assert run("logs", "--score", "obs:grip").startswith("obs:grip > 1.19")
    assert run("logs", "--score", "action:grip").startswith("action:grip > 2.38")
    assert "Known: grip\n" in run("logs", "--score", "speed", code=4)


@pytest.mark.parametrize("write", [write_lerobot, write_csv])
def test_a_recipe_elsewhere_finds_the_logs_that_are_named(write, run, tmp_path):
    column = "chunk_mse" if write is write_lerobot else "residual"
    write(tmp_path / "data" / "logs", range(20))
    (tmp_path / "else").mkdir()
    assert main(["data", "inspect", "data/logs", "--recipe", "else/arm.toml", "-q"]) == 0
    text = run("data/logs", "--recipe", "else/arm.toml", "--score", column)
    assert text.startswith(f"{column} > 1.19")
    refused = run("else", "--recipe", "else/arm.toml", "--score", column, code=4)
    assert "'else' holds no file that the recipe lists" in refused


def test_what_is_no_log_and_no_split_is_said(run, tmp_path):
    write_csv(tmp_path / "logs", range(2))
    assert "'log' is no file or folder of logs, and an unknown split" in run(
        "log", "--score", "residual", code=4
    )
    (tmp_path / "arm.toml").write_text('split = "arm"\nnominal.files = ["*.csv"]\n')
    refused = run("mini", "--recipe", "arm.toml", "--score", "residual", code=4)
    assert "--recipe is for logs, and 'mini' is none" in refused
    refused = run("logs", "--score", "residual", "--hold", ROWS + 1, code=4)
    assert f"in {ROWS + 1} rows at least (hold)" in refused
    (tmp_path / "empty").mkdir()
    assert "--format, or a recipe, says" in run("empty", "--score", "residual", code=4)


def test_logs_that_labels_make_anomalous_are_said(run, tmp_path):
    write_csv(tmp_path / "logs", range(6), fault=lambda _: 1, airframe=lambda _: "quad")
    (tmp_path / "arm.toml").write_text(
        'split = "arm"\nsensors = ["speed"]\nlabels = "fault"\nnominal.files = ["*.csv"]\n'
    )
    arguments = ("logs", "--recipe", "arm.toml", "--score", "residual", "--per", "airframe")
    refused = run(*arguments, code=4)
    assert "0 healthy logs, too few for 5 %" in refused
    assert "Labels make all 6 logs anomalous: a recipe" in refused


def test_one_log_is_one(run, tmp_path):
    write_csv(tmp_path / "logs", range(1))
    text = run("logs", "--score", "residual", "--level", 50)
    assert "from 1 healthy log)." in text
    assert 'default: ""' not in run("--help")


def test_few_logs_show_no_drift(run, tmp_path):
    write_csv(tmp_path / "logs", range(5))
    assert "Drift shows in 6 logs and more." in run("logs", "--score", "residual", "--level", 20)
    write_csv(tmp_path / "logs", range(6))
    assert "rank correlation" in run("logs", "--score", "residual", "--level", 20)


def test_a_negative_zero_is_zero(run, tmp_path):
    for i in range(19):
        write_table(tmp_path / "logs" / f"run-{i:02}.csv", {"rest": [0, 1, 2, i]})
    assert run("logs", "--score=-rest").startswith("-rest > 0\n")


def test_one_file_of_a_recipe_is_one_log(run, tmp_path):
    write_csv(tmp_path / "logs", range(20))
    assert main(["data", "inspect", "logs", "--recipe", "arm.toml", "-q"]) == 0
    few = run("logs/run-03.csv", "--recipe", "arm.toml", "--score", "residual", code=4)
    assert "1 healthy log, too few" in few


def test_training_and_calibration_episodes_of_a_split_are_healthy(run, tmp_path):
    parts = log_parts(train=9, calibration=10, nominal=8)
    write_log_split(tmp_path / "arm", parts)
    healthy = [e.observations[:, 2] for e in (*parts["train"], *parts["calibration"])]
    threshold = max(np.abs(values.astype(np.float32)).max() for values in healthy)
    text = run("arm", "--score", "|q2|")
    assert float(text.split()[2]) == pytest.approx(threshold, rel=1e-5)
    above = sum(np.abs(e.observations[:, 2]).max() > threshold for e in parts["test/nominal"])
    assert f"Of 8 further healthy logs {above} alarm" in text
    assert "9 training and 10 calibration episodes" in text
    slips = [np.abs(e.observations[:, 2]) > threshold for e in parts["test/slip"]]
    firsts = np.array([above.argmax() for above in slips])  # each begins at row 30
    assert all(above.any() for above in slips)
    assert (
        f"Of 5 logs with slip: {(firsts >= 30).sum()} alarm once it began, by a median delay of "
        f"{np.median(firsts[firsts >= 30]) - 30:g} rows; {(firsts < 30).sum()} before it began"
    ) in text
    assert "field or column 'task'" in run("arm", "--score", "|q2|", "--per", "task", code=4)
    assert "keeps no field but the task" in run("arm", "--score", "|q2|", "--per", "frame", code=4)


def test_baseline_rows_are_no_scores_and_what_a_split_subtracts_is_added_again(run, tmp_path):
    parts = log_parts(train=9, calibration=10)
    for episodes in parts.values():
        for episode in episodes:
            episode.observations[3] = 99.0  # in the baseline
    facts = LogFacts(paired=False, baseline=10, offsets=(0.0, 0.0, 5000.0))
    write_log_split(tmp_path / "arm", parts, facts)
    healthy = [e.observations[10:, 2] for e in (*parts["train"], *parts["calibration"])]
    threshold = 5000 + max(values.astype(np.float32).max() for values in healthy)
    assert float(run("arm", "--score", "q2", "-q").split()[2]) == pytest.approx(threshold, rel=1e-5)
    write_csv(tmp_path / "logs", range(20))
    keys = "split = 's'\nsensors = ['residual']\nbaseline = 21\nnominal.files = '*.csv'\n"
    (tmp_path / "arm.toml").write_text(keys)
    largest = max(signal(i)[21:].max() for i in range(20))
    text = run("logs", "--recipe", "arm.toml", "--score", "residual", "-q")
    assert float(text.split()[2]) == pytest.approx(largest, abs=1e-3)


def test_the_page_shows_what_is_printed(run, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "monitors.md").read_text()
    program, shown, refused = (
        re.search(pattern, page, re.MULTILINE | re.DOTALL)[1]
        for pattern in (
            r"^```python\n(.*?)^```$",
            r"^```text\n(\|.*?)^```$",
            r"run-00.*?\n(.*?)^```$",
        )
    )
    exec(program, {})  # noqa: S102  of the page
    monkeypatch.setenv("COLUMNS", "100")
    assert run("runs", "--score", "|residual|") == shown
    assert run("runs/run-00.csv", "--score", "residual", code=4) == refused
