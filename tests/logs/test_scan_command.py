"""What a person sees of a scan: the command, its lists, the page, and files for viewers."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from helpers_logs import log_episode, write_table
from oodd_live import Watchdog
from oodd_logs import scan_episodes
from oodd_logs.episodes import EVERY, Episode, read_every_episode
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.logs import read_logs
from oodd_logs.scanning.scan_page import PICTURES, page, picture
from oodd_logs.scanning.viewers import foxglove_link, write_mcap, write_rerun

from oodd_eval.cli.main import main
from oodd_eval.errors import MissingExtraError

ROOT = Path(__file__).parents[2]
SENSORS = ["speed", "torque", "current"]


def logs(seed=0, n=20, rows=150):
    """Episodes of a stable linear process; the fault of one is far above its noise."""
    return [log_episode(1000 * seed + i, rows).observations for i in range(n)]


def recorded(rows, name="one", **facts):
    return Episode(name, f"{name}.csv", rows, np.empty((len(rows) - 1, 0)), None, **facts)


def write_logs(folder, episodes, names=SENSORS):
    folder.mkdir(parents=True, exist_ok=True)
    for i, rows in enumerate(episodes):
        cells = [["" if np.isnan(x) else f"{x:.6f}" for x in column] for column in rows.T]
        time = [f"{0.1 * t:.3f}" for t in range(len(rows))]
        write_table(
            folder / f"run-{i:02}.csv", dict(zip(["t[s]", *names], [time, *cells], strict=True))
        )


def lines_of(text, word):
    """Names behind a word at the beginning of lines."""
    return [line.split()[1] for line in text.splitlines() if line.startswith(f"{word} ")]


@pytest.fixture(scope="module")
def scan():
    episodes = [
        recorded(x, f"run <{i}>", time=100 + 0.1 * np.arange(150)) for i, x in enumerate(logs())
    ]
    episodes[5].observations[90:, 1] += 4
    episodes[7].observations[20:40, 2] = np.nan
    return scan_episodes(episodes, sensors=SENSORS, detector="mewma")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Logs of which one has a fault from row 90 on, and one misses rows 60 to 74."""
    episodes, path = logs(), tmp_path_factory.mktemp("scan") / "logs"
    episodes[5][90:, 1] += 4
    episodes[7][60:75, 0] = np.nan
    write_logs(path, episodes)
    return path


def run(capsys, *words):
    """Exit code and output of a scan by a quick detector."""
    code = main(["scan", *map(str, words), "--detector=mewma"])
    return code, capsys.readouterr().out


# The command


def test_bands_reasons_and_next_steps(folder, capsys):
    code, out = run(capsys, folder)
    assert code == 1
    assert {*lines_of(out, "odd")} == {"run-05", "run-07"}
    # The first are listed in any case, the oddest first.
    listed = [name for word in ("odd", "look", "fine") for name in lines_of(out, word)]
    assert len(listed) == 10
    assert re.search(r"^odd  +run-05 +9\d +9(\.\d)? .*torque", out, re.MULTILINE)
    counts = r"^2 of 20 episodes are odd \(.*0.1\); (\d+) to look at; (\d+) fine\.$"
    summary = re.search(counts, out, re.MULTILINE)
    assert sum(map(int, summary.groups())) == 18
    assert len(lines_of(out, "look")) == int(summary[1])
    text = " ".join(out.split())
    assert re.search(r"Next, look at run-0[57] from row \d+: .*(torque|speed)", text)
    assert all(option in text for option in ("--fine ", "--drop FILE", "--keep FILE"))
    assert "Not listed: 10 less odd episodes" in text


def test_more_and_less_is_listed_as_told(folder, capsys):
    _, out = run(capsys, folder, "--first=2")
    assert len(re.findall(r"^\w* +run-", out, re.MULTILINE)) < 10
    _, out = run(capsys, folder, "-v")
    assert len(re.findall(r"^\w* +run-", out, re.MULTILINE)) == 20
    assert "Not listed" not in out
    code, out = run(capsys, folder, "-q")
    assert (code, out.count("\n")) == (1, 1)


def test_verdicts_are_told_before_the_end(folder, capsys):
    main(["scan", str(folder), "--detector=mewma"])
    assert re.search(r"First verdicts, the oddest first: run-0[57], ", capsys.readouterr().err)
    main(["scan", str(folder), "--detector=mewma", "-q"])
    assert not capsys.readouterr().err


def test_lists_for_tools_that_delete(folder, tmp_path, capsys):
    lists = {name: tmp_path / name for name in ("keep.txt", "drop.txt")}
    run(capsys, folder, *(f"--{path.stem}={path}" for path in lists.values()))
    keep, drop = (path.read_text().splitlines() for path in lists.values())
    assert drop == ["run-05", "run-07"]
    assert sorted(keep + drop) == [f"run-{i:02}" for i in range(20)]
    # A recording is odd if any piece of it is.
    run(capsys, folder, "--window=50", f"--drop={tmp_path}/drop.json")
    assert {*json.loads((tmp_path / "drop.json").read_text())} <= {*keep, *drop}


def test_lists_of_data_sets_that_number_their_episodes(tmp_path, capsys):
    h5py = pytest.importorskip("h5py")
    episodes = logs()
    episodes[5][90:, 1] += 4
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        for i, rows in enumerate(episodes):
            file[f"data/episode_{i}/obs/state"] = rows
            file[f"data/episode_{i}/actions"] = np.zeros((len(rows), 1))
    code, _ = run(capsys, tmp_path / "demo.hdf5", f"--drop={tmp_path}/drop.json",
                  f"--keep={tmp_path}/keep.txt")  # fmt: skip
    assert code == 1
    assert json.loads((tmp_path / "drop.json").read_text()) == [5]
    assert "episode_4\n" in (tmp_path / "keep.txt").read_text()


@pytest.mark.parametrize("form", ["names", "globs", "file"])
def test_confirmed_episodes_are_not_odd(form, folder, tmp_path, capsys):
    names = ["run-05", *(f"run-1{i}" for i in range(10))]
    (tmp_path / "fine.txt").write_text("\n".join([*names, ""]))
    fine = {"names": ",".join(names), "globs": "run-05, run-1*", "file": tmp_path / "fine.txt"}
    out = tmp_path / "scan.json"
    _, text = run(capsys, folder, f"--fine={fine[form]}", f"--json={out}")
    assert {*lines_of(text, "odd")} <= {"run-07"}
    bands = {e["name"]: e["band"] for e in json.loads(out.read_text())["episodes"]}
    assert {bands[name] for name in names} == {"fine"}


def test_a_name_of_no_episode_is_an_error_with_the_nearest(folder, capsys):
    assert main(["scan", str(folder), "--detector=mewma", "--fine=run-06,rum-05"]) == 4
    assert "'rum-05'" in (error := capsys.readouterr().err)
    assert "run-05" in error


def test_outputs_beside_logs_are_written_again(folder, tmp_path, capsys, monkeypatch):
    read = {file: file.read_bytes() for file in folder.iterdir()}
    monkeypatch.chdir(folder)
    names = {"html": "scan.html", "json": "scan.json", "keep": "keep.lst", "mcap": "scan.mcap"}
    options = [f"--{kind}={name}" for kind, name in names.items()]
    for _ in range(2):
        code, out = run(capsys, ".", *options)
        assert code == 1
        assert "2 of 20 episodes" in out
    for option in ("--html", "--keep", "--drop", "--mcap"):
        assert main(["scan", ".", f"{option}=run-03.csv"]) == 4
        assert f"{option} 'run-03.csv' would overwrite" in capsys.readouterr().err
    assert main(["scan", ".", "--fine=keep.lst", "--drop=keep.lst"]) == 4
    assert {file: file.read_bytes() for file in read} == read
    for name in names.values():
        (folder / name).unlink()


def test_the_page_links_to_what_is_served(folder, tmp_path, capsys):
    files = [f"--html={tmp_path}/scan.html", f"--mcap={tmp_path}/scan 1.mcap"]
    _, out = run(capsys, folder, *files, "--served=http://localhost:8000/")
    text = (tmp_path / "scan.html").read_text()
    links = [m.replace("&amp;", "&") for m in re.findall(r'href="(foxglove:[^"]*)"', text)]
    assert len(links) == 10
    assert links[0] in out
    query = parse_qs(urlsplit(links[0]).query)
    assert query["ds.url"] == ["http://localhost:8000/scan%201.mcap"]
    assert main(["scan", str(folder), "--served=here"]) == 4


def test_labels_decide_nothing_and_their_places_are_said(tmp_path, capsys):
    write_logs(tmp_path / "logs", logs())
    for number, file in enumerate(sorted((tmp_path / "logs").iterdir())):
        header, *rows = file.read_text().splitlines()
        lines = [f"{row},{int(number < 3 and i > 80)}" for i, row in enumerate(rows)]
        file.write_text("\n".join([f"{header},fault", *lines]) + "\n")
    code, out = run(capsys, tmp_path / "logs", f"--json={tmp_path}/scan.json")
    content = json.loads((tmp_path / "scan.json").read_text())
    places = sorted(episode["position"] for episode in content["episodes"] if episode["label"])
    said = f"3 episodes, 0 of them odd here; their places are {', '.join(map(str, places))}."
    assert f"Anomalous by their labels: {said}" in " ".join(out.split())
    assert code == 0


def test_files_without_rows_end_no_scan(folder, tmp_path, capsys):
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "empty.csv").write_text("t[s],speed,torque,current\n")
    (tmp_path / "nothing.csv").touch()
    code, out = run(capsys, tmp_path, f"--json={tmp_path}/scan.json")
    assert code == 1
    assert "2 of 20 episodes are odd" in out
    assert "empty.csv" in out
    assert "nothing.csv" in out
    ledger = json.loads((tmp_path / "scan.json").read_text())["ledger"]
    dropped = [entry["examples"] for entry in ledger if entry["fate"] == "dropped"]
    assert {"empty.csv", "nothing.csv"} <= {source for sources in dropped for source in sources}


def test_recipe_and_watchdog(tmp_path, capsys):
    episodes = logs()
    recipe = tmp_path / "arm.toml"
    recipe.write_text(
        'split = "arm"\ntime = "t"\nrate = 10\nsensors = ["speed", "torque", "current"]\n'
        '[nominal]\nfiles = ["good/*.csv"]\n[anomalous.leak]\nfiles = ["bad/*.csv"]\nonset = 90\n'
    )
    write_logs(tmp_path / "data/good", episodes)
    episodes[5][90:, 1] += 4
    write_logs(tmp_path / "data/bad", episodes[5:6])
    arguments = ["--recipe", str(recipe), "--json", str(tmp_path / "scan.json")]
    assert main(["scan", str(tmp_path / "data"), *arguments, "--detector=mewma"]) == 1
    content = json.loads((tmp_path / "scan.json").read_text())
    (odd,) = [one for one in content["episodes"] if one["odd"]]
    assert (odd["label"], odd["suspects"]) == ("leak, 90 to 150", ["torque"])
    assert "leak" in capsys.readouterr().out
    watchdog = Watchdog.fit("mewma", episodes[6:13], episodes[13:] + logs(9), 0.1, sensors=SENSORS)
    watchdog.save(tmp_path / "watchdog")
    write_logs(tmp_path / "today", episodes[4:6])
    arguments += ["--watchdog", str(tmp_path / "watchdog")]
    assert main(["scan", str(tmp_path / "today"), *arguments]) == 1
    assert json.loads((tmp_path / "scan.json").read_text())["odd"] == ["run-01"]


@pytest.mark.parametrize(
    "arguments",
    [["nowhere"], ["logs", "--fdr", "1.5"], ["logs", "--detector", "mewmo"], ["logs", "--recipe",
     "none.toml"], ["logs", "--watchdog", "none"], ["logs", "--param", "x=1"]],
)  # fmt: skip
def test_command_that_cannot_be_carried_out(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_logs(tmp_path / "logs", logs(n=8, rows=30))
    assert main(["scan", *arguments]) == 4


# What is written


def test_json_holds_what_the_page_of_scans_documents(scan):
    content = json.loads(json.dumps(scan.as_json(), allow_nan=False))
    text = (ROOT / "docs" / "how-to" / "scan.md").read_text(encoding="utf-8")
    for part, heading in ((content, "### JSON"), (content["episodes"][5], "#### An episode")):
        section = text.partition(f"{heading}\n")[2].partition("\n#")[0]
        assert list(part) == re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    assert content["odd"] == ["run <5>", "run <7>"]
    fifth, seventh = content["episodes"][5], content["episodes"][7]
    assert fifth["first_odd_time"] == pytest.approx(100 + 0.1 * fifth["first_odd_row"])
    assert seventh["faults"] == [{"what": "current", "fault": "missing", "row": 20}]
    assert seventh["suspects"] == ["current"]


def test_page_needs_nothing_else_and_ranks_episodes_in_bands(scan):
    text = page(scan, "logs & more", first=6)
    shown = [s for s in scan.ranked if s.position <= 6 or s.band != "fine"]
    assert text.count("<svg") == text.count("</svg>") == len(shown)
    addresses = re.findall(r"""(?:href|src)=["']([^"']*)""", text)
    assert addresses == [f"#episode-{one.position}" for one in shown]
    assert not re.search(r"https?:|<script|<link|@import|url\(", text)
    assert "logs &amp; more" in text
    assert "run <5>" not in text
    titles = re.findall(r"<h3[^>]*>(\d+)\. (run &lt;\d+&gt;)</h3>", text)
    assert [int(place) for place, _ in titles] == list(range(1, len(shown) + 1))
    headings = re.findall(r'<h2 class="(\w+)">', text)
    assert headings == [h for h in ("odd", "look", "fine") if h in headings]


def test_pictures_are_of_suspects_beside_the_others(scan):
    fifth, seventh = scan.episodes[5], scan.episodes[7]
    drawn = picture(fifth, scan)
    assert re.findall(r'class="name">([^<]*)<', drawn) == ["torque", "statistic"]
    assert drawn.count('class="usual"') == 1  # the range of the others
    assert drawn.count('class="first"') == 2  # the odd row
    assert re.findall(r'class="name">([^<]*)<', picture(seventh, scan))[0] == "current"
    # No statistic is drawn that stays below its threshold.
    below = replace(fifth, intervals=(), sensors={"current": 1.0})
    assert re.findall(r'class="name">([^<]*)<', picture(below, scan)) == ["current"]
    nowhere = picture(replace(below, since=None, row=None), scan)
    assert 'class="first"' not in nowhere
    assert ">row 149</text>" in nowhere


def test_pictures_are_bounded(scan):
    places = [replace(scan.odd[0], position=i + 1) for i in range(PICTURES + 7)]
    text = page(replace(scan, episodes=places))
    assert text.count("<svg") == PICTURES
    assert "7 more" in text
    long = [recorded(x, f"e{i}") for i, x in enumerate(logs(n=9, rows=12_000))]
    long[2].observations[9_000:, 1] += 40
    assert len(page(scan_episodes(long, detector="mahalanobis", first=2), first=2)) < 200_000


@pytest.mark.browser
def test_page_in_a_browser(scan, tmp_path):
    from helpers_browser import launch, programs

    if programs() is None:
        pytest.skip("no Chromium with its driver")
    (tmp_path / "scan.html").write_text(page(scan, "logs"), encoding="utf-8")
    with launch(tmp_path) as browser:
        browser.open((tmp_path / "scan.html").as_uri())
        browser.requests()  # of the browser's own first page, too
        for width, theme in ((1200, "light"), (1200, "dark"), (390, "light"), (390, "dark")):
            with browser.narrow(width), browser.colours(theme):
                browser.open((tmp_path / "scan.html").as_uri())
                assert not browser.defects(width)
        assert not browser.console()
        assert {url.partition(":")[0] for url in browser.requests()} <= {"file", "data"}


def test_mcap_is_read_back(scan, tmp_path):
    from mcap.reader import make_reader

    write_mcap(scan, tmp_path / "scan.mcap")
    with (tmp_path / "scan.mcap").open("rb") as file:
        messages = [
            (channel.topic, message.log_time, json.loads(message.data), json.loads(schema.data))
            for schema, channel, message in make_reader(file).iter_messages()
        ]
    assert {topic for topic, *_ in messages} == {
        f"/run <{i}>/{kind}" for i in range(20) for kind in ("sensors", "oodd")
    }
    fifth = scan.episodes[5]
    verdicts = [(t, m, s) for topic, t, m, s in messages if topic == "/run <5>/oodd"]
    assert len(verdicts) == 150
    for row in (0, fifth.row):
        stamp, message, schema = verdicts[row]
        assert stamp == round((100 + 0.1 * row) * 1e9)
        assert schema["properties"].keys() == message.keys()
        assert message["alarm"] == (row == fifth.row)
        assert message["suspects"] == (["torque"] if message["alarm"] else [])
    assert verdicts[50][1]["score"] == fifth.scores[50]
    # A link leads to the first odd row.
    query = parse_qs(urlsplit(foxglove_link(fifth, "https://a/b?c=d&e")).query)
    stamp = np.datetime64(query["time"][0].removesuffix("Z"), "ns").astype(int)
    assert (query["ds"], query["ds.url"]) == (["remote-file"], ["https://a/b?c=d&e"])
    assert stamp == verdicts[fifth.first][0]
    seventh = [m for topic, _, m, _ in messages if topic == "/run <7>/sensors"]
    assert seventh[19].keys() == {*SENSORS}
    assert seventh[19]["current"] is not None
    assert seventh[20]["current"] is None


def test_rerun_is_read_back(scan, tmp_path, monkeypatch):
    from rerun.chunk import RrdReader

    write_rerun(scan, tmp_path / "scan.rrd")
    entities = {}
    for chunk in RrdReader(tmp_path / "scan.rrd").stream():
        entities.setdefault(str(chunk.entity_path), []).append(chunk)
    kinds = ["score", "statistic", "threshold", "alarm", *(f"sensors/{s}" for s in SENSORS)]
    paths = {re.sub(r"\\", "", path) for path in entities}
    assert {f"/run <{i}>/{kind}" for i in range(20) for kind in kinds} <= paths
    assert {f"/run <{i}>/suspects" for i in (5, 7)} <= {p for p in paths if "suspects" in p}
    for module, write in (("rerun", write_rerun), ("mcap.writer", write_mcap)):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError, match="viewers"):
            write(scan, tmp_path / "other")
    assert not (tmp_path / "other").exists()


# Logs


def test_every_row_is_read_whatever_labels_stamps_and_cells_say(tmp_path):
    rows = np.arange(60.0).reshape(30, 2)
    time = 0.1 * np.arange(30)
    time[20:] += 50  # a gap
    time[5] = 0.05  # back
    rows[0, 0] = rows[12, 1] = np.nan
    lines = [f"{t:.2f},{a},{b},{int(i > 24)}"
             for i, (t, (a, b)) in enumerate(zip(time, rows, strict=True))]  # fmt: skip
    text = "\n".join(["t,a,b,fault", *lines]).replace("nan", "")
    (tmp_path / "x.csv").write_text(f"{text}\n", encoding="utf-8")
    recipe = Recipe.parse(
        {"split": "x", "time": "t", "labels": "fault", "sensors": ["a", "b"],
         "nominal": {"files": ["x.csv"]}}
    )  # fmt: skip
    with read_every_episode(recipe, tmp_path, [tmp_path / "x.csv"]) as source:
        first, second = source.episodes(EVERY)
    # The leading row and the one that is stamped before another are left out.
    assert first.observations[:, 0].tolist() == [2 * i for i in range(1, 20) if i != 5]
    assert np.flatnonzero(np.isnan(first.observations[:, 1])).tolist() == [10]
    assert (len(second.observations), second.intervals, second.kind) == (
        10,
        ((5, 10),),
        "anomalous",
    )
    assert second.time[0] - first.time[-1] == pytest.approx(50.1)


def test_files_that_a_recipe_does_not_list_are_read(tmp_path):
    write_logs(tmp_path / "data/good", logs(n=2, rows=30))
    write_logs(tmp_path / "data/bad", logs(n=2, rows=30))
    recipe = Recipe.parse(
        {"split": "x", "time": "t", "sensors": SENSORS, "nominal": {"files": ["data/good/*.csv"]},
         "anomalous": {"leak": {"files": ["data/bad/*.csv"], "onset": 3}}, "task": "task"}
    )  # fmt: skip
    # Files of a recipe are relative to its folder, to the logs, or to the folder that these are in.
    for place, home in (("data", ""), ("", "recipes"), ("data", "recipes")):
        read = read_logs(tmp_path / place, recipe, home=tmp_path / home)
        assert sorted(one.kind for one in read.episodes) == ["", "", "leak", "leak"]
    elsewhere = read_logs(tmp_path / "data/bad", recipe, home=tmp_path / "recipes")
    assert [(one.name, one.kind) for one in elsewhere.episodes] == [("run-00", ""), ("run-01", "")]
    (one,) = read_logs(tmp_path / "data/bad/run-01.csv", recipe).episodes
    assert one.name == "run-01"
    assert len(read_logs(tmp_path / "data/bad", recipe, window=10).episodes) == 6


def test_the_list_on_the_page_of_scans_is_that_of_its_program(tmp_path, monkeypatch, capsys):
    text = (ROOT / "docs" / "how-to" / "scan.md").read_text(encoding="utf-8")
    program, shown = (re.search(f"^```{kind}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)[1]
                      for kind in ("python", "text"))  # fmt: skip
    monkeypatch.chdir(tmp_path)
    exec(program, {})  # noqa: S102  of the page
    assert main(["scan", "logs"]) == 1
    out = capsys.readouterr().out
    first = [re.findall(r"^(odd|look) +(\S+)", part, re.MULTILINE)[:3] for part in (shown, out)]
    assert first[0] == first[1]
    assert {name for _, name in first[0]} == {"run-05", "run-17", "run-23"}
    for line in re.findall(r"^\d+ of \d+ episodes? .* odd", shown, re.MULTILINE):
        assert line in out
