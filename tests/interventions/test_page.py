"""Tables, Markdown and pages of studies of interventions."""

import math
import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from helpers_studies import ARMS, episode, naming, study_cell
from oodd_interventions.columns import records_of
from oodd_interventions.page import plot, sections, write_pages

SAVES = [100, 20, 80, 100, 30, 90, 95]
COSTS_NOTHING = [100, 99, 69, 100, 99, 90, 95]


def cells(*detectors, environments=("hopper", "cartpole"), act="mask"):
    """Cells in which the first detector saves most; iid can be mended and drift cannot."""
    made = []
    for environment in environments:
        for i, detector in enumerate(detectors):
            for anomaly, returns in (("iid", SAVES), ("drift", COSTS_NOTHING)):
                changed = [*returns[:2], returns[2] - 20 * i, *returns[3:]]
                named = {"0": naming(0, 1)} if detector == "panel" else {}
                episodes = [
                    episode(s, [x + (s if x < 90 else 0) for x in changed], named=named)
                    for s in range(6)
                ]
                made.append(study_cell(episodes, detector, environment, anomaly, act=act))
    return made


def table(parts, title):
    (wanted,) = (t for part in parts for t in part.tables if t.title.startswith(title))
    return [dict(zip(wanted.header, row, strict=True)) for row in wanted.rows]


def test_the_first_sentence_says_what_the_best_alarm_is_worth():
    first, *_ = sections(records_of(cells("panel", "riqn")))
    assert re.sub(r" \[[\d., ]+\]", "", first.verdict) == (
        "The alarm of panel is worth having: mask at the alarm saves 77.4 % of the return that "
        "mask at once, on the true parts, would save; at another episode's alarm it saves 12.9 %. "
        "Of the nominal return false alarms cost 10.0 %, and acting where nothing needs it 15.8 %."
    )


@pytest.mark.parametrize("watchdog", [29, 15])
def test_an_alarm_that_saves_no_more_than_the_placebo_is_not_called_worth_having(watchdog):
    episodes = [episode(s, [100, 20, watchdog, 100, 30, 100, 100]) for s in range(6)]
    first, *_ = sections(records_of([study_cell(episodes)]))
    assert "is not shown to be worth having" in first.verdict


def test_few_seeds_show_nothing():
    for seeds, doubt in ((1, "not shown by 1 seed to be"), (4, "not shown by 4"), (5, "is worth")):
        episodes = [episode(s, SAVES) for s in range(seeds)]
        first, *_ = sections(records_of([study_cell(episodes)]))
        assert doubt in first.verdict


@pytest.mark.parametrize("twin", [0.0, math.nan])
def test_shares_of_no_nominal_return_are_not_known(twin, tmp_path):
    """Rewards may be rare, so that nominal episodes have none."""
    episodes = [episode(s, [twin, -20, -10, 0, -20, 0, 0]) for s in range(2)]
    made = [study_cell(episodes)]
    parts = sections(records_of(made))
    assert table(parts, "Faults that mask cannot mend")[0]["fault"] == "\N{EN DASH}"
    write_pages(tmp_path, made)


def test_faults_that_nothing_can_mend_are_said_to_be_such():
    drift = [c for c in cells("panel") if c["anomaly"] == "drift"]
    first, *_ = sections(records_of(drift))
    assert "mask cannot mend these faults" in first.verdict


def test_detectors_are_rows_and_environments_columns():
    parts = sections(records_of(cells("riqn", "panel", "rf")))
    rows = table(parts, "Return saved by mask")
    assert [row["detector"] for row in rows] == ["riqn", "panel", "rf"]
    assert [*rows[0]] == ["detector", "mean", "placebo", "harm on nominal", "cartpole", "hopper"]
    assert rows[0]["hopper"] == "77.4 (12.9)"
    assert (rows[2]["placebo"], rows[2]["harm on nominal"]) == ("12.9", "10.0")
    behind = re.findall(r"(\w+) is ([\d.]+) \[[^]]*\] behind riqn, p", parts[0].tables[0].note)
    assert behind == [("panel", "25.8"), ("rf", "51.6")]


def test_with_one_environment_kinds_are_columns():
    rows = table(sections(records_of(cells("panel", environments=["hopper"]))), "Return saved")
    # Drift costs nothing that could be saved: it stands among the faults that no act can mend.
    assert [*rows[0]] == ["detector", "mean", "placebo", "harm on nominal", "iid"]


def test_what_acting_on_harmless_faults_costs_is_listed():
    rows = table(sections(records_of(cells("panel", "riqn"))), "Faults that mask cannot mend")
    assert [*rows[1].values()] == ["hopper", "drift", "1.0", "27.5", "47.5"]
    assert [*rows[1]] == ["environment", "anomaly", "fault", "panel", "riqn"]


def test_rows_that_name_nothing_have_no_place_among_namings():
    rows = table(sections(records_of(cells("panel", "riqn"))), "Parts named")
    assert [row["detector"] for row in rows] == ["panel"]
    assert (rows[0]["Named precision"], rows[0]["Named recall"]) == ("50.0", "50.0")


def test_each_act_has_tables_of_its_own():
    both = cells("panel") + cells("panel", act="stop")
    titles = [part.title for part in sections(records_of(both))]
    assert titles[:2] == ["Acting by mask", "Acting by stop"]


def test_pages_are_whole_documents_that_need_no_other_file(tmp_path):
    study = cells("panel", "a<b")
    write_pages(tmp_path, study)
    assert {p.name for p in tmp_path.iterdir()} == {
        "records.jsonl", "report.md", "hopper.html", "cartpole.html",
    }  # fmt: skip
    page = (tmp_path / "hopper.html").read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>")
    assert not re.search(r"<script|(src|href)=|url\(|@import", page)
    assert "a<b" not in page
    assert page.count('role="img"') == 4
    assert "prefers-color-scheme: dark" in page
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert report.startswith("## Acting by mask\n\n**The alarm of panel is worth having")
    before = page, report, (tmp_path / "records.jsonl").read_bytes()
    write_pages(tmp_path, study[::-1])
    assert before[1:] == (
        (tmp_path / "report.md").read_text(encoding="utf-8"),
        (tmp_path / "records.jsonl").read_bytes(),
    )


def drawn(cell):
    """Points of each arm in the plot of a cell, its other elements by class, and its words."""
    drawing, words = plot(cell)
    root = ET.fromstring(drawing)  # noqa: S314  our own
    lines = {
        e.get("class"): np.array([p.split(",") for p in e.get("points").split()], float)
        for e in root.findall("{*}polyline")
    }
    marks = {e.get("class"): e.get("d") for e in root.findall("{*}path") if "V" in e.get("d")}
    return lines, marks, words


def test_a_plot_shows_what_arms_gain_on_the_twins():
    """Never loses 1 a row from the effect on, and ends after 30 rows; its twin goes on with 2."""
    twin = [2.0] * 80
    arms = dict.fromkeys(ARMS, twin) | {"never": [2.0] * 20 + [1.0] * 30}
    alarms = [42, None, 39, 47]  # the effect is at 40
    episodes = [episode(s, SAVES, alarm=a) for s, a in enumerate(alarms)]
    lines, marks, words = drawn(study_cell(episodes, curves={"first": -20, "arms": arms}))
    assert {*lines} == {*ARMS} - {"twin"}
    assert "never -90, watchdog 0" in words  # 30 rows of 1, then 30 rows of 2
    assert "2 of 4 episodes alarm" in words
    never, watchdog = lines["never"], lines["watchdog"]
    assert np.ptp(watchdog[:, 1]) == 0
    assert never[0, 1] == never[19, 1] == watchdog[0, 1]
    assert never[-1, 1] == never[:, 1].max()  # downwards in pixels
    effect, alarm = (float(marks[name][1:].split()[0]) for name in ("effect", "alarm"))
    assert effect == pytest.approx(never[20, 0], abs=0.1)
    assert alarm == pytest.approx(never[27, 0], abs=0.1)


def test_a_plot_without_an_alarm_has_no_mark_of_one():
    episodes = [episode(s, SAVES, alarm=None) for s in range(2)]
    lines, marks, words = drawn(study_cell(episodes))
    assert {*marks} == {"effect"}
    assert "0 of 2 episodes alarm" in words
    assert len({line.tobytes() for line in lines.values()}) == 1


def test_a_long_line_has_few_points_and_its_end():
    arms = {arm: [1.0] * 5000 for arm in ARMS}
    curves = {"first": -20, "arms": arms}
    lines, _, _ = drawn(study_cell([episode(1, SAVES)], curves=curves))
    assert 150 < len(lines["never"]) <= 202
    assert lines["never"][-1, 0] == 472  # the right end of the axes
