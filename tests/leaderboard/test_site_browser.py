"""The site in a real browser, opened from disk: its first view, filters, keyboard, a row's page."""

import itertools
import shlex
import time
import urllib.parse

import helpers_site
import pytest
from helpers_docs import ROOT
from helpers_records import make_record
from oodd_leaderboard import site
from oodd_leaderboard.curve_file import read_curves
from oodd_leaderboard.reported import REPORTED, Reported, sections

from oodd_eval.cli.main import main
from oodd_eval.data.facts import ANOMALIES
from oodd_eval.data.split import published_digests
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.tables import show_value

pytestmark = pytest.mark.browser

LABELS = "#ranking tbody th > a"

FIVE = ["Matched AUC", "Worst environment", "Found within 20", "Missed", "False episodes"]

DASH = "\N{EN DASH}"


def written(directory, *boards):
    """Address of a site of some boards."""
    links = {name: f"../../{name}" for name in site.LINKS}
    return helpers_site.write_site(directory, site.files(*boards, links=links))


@pytest.fixture(scope="module")
def url(reported, season, tmp_path_factory):
    directory = tmp_path_factory.mktemp("site")
    return written(directory, reported, helpers_site.graded(directory), [season])


@pytest.fixture
def browser(window, url):
    """A freshly opened page, which afterwards has to have been silent."""
    window.open("about:blank")
    window.console()
    window.requests()
    window.open(url)
    yield window
    assert window.console() == []
    # The page itself, its data files, and its empty icon.
    asked = {request.partition("#")[0] for request in window.requests()}
    beside = url.removesuffix(site.PAGE) + site.PARTS + "/"
    assert {request for request in asked if not request.startswith(beside)} <= {url, "data:,"}


def column_titles(browser):
    return [text.rstrip("↕▼▲").replace("\n", " ").strip()
            for text in browser.texts("#ranking thead button")]  # fmt: skip


def column(browser, title):
    """Texts of the values of one column, by row."""
    until = time.monotonic() + 10  # a column may need a data file that is loaded
    while title not in (titles := column_titles(browser)) and time.monotonic() < until:
        time.sleep(0.02)
    cells = browser.texts(f"#ranking tbody tr > :nth-child({titles.index(title) + 1})")
    return dict(zip(browser.texts(LABELS), cells, strict=True))


def open_row(browser, label):
    browser.run(
        "[...document.querySelectorAll(arguments[0])].find((a) => a.textContent === arguments[1])"
        ".click()",
        LABELS,
        label,
    )
    browser.wait_for("document.querySelector('#detector h1') !== null")


def choose_board(browser, name):
    browser.run(
        "[...document.querySelectorAll('#boards label')].find((e) => e.innerText === arguments[0])"
        ".querySelector('input').click()",
        name,
    )


def open_view(browser, url, view):
    """Open a page by its address; ``detector`` is the first row's."""
    if view == "detector":
        (row, *_) = browser.run(
            "return [...document.querySelectorAll('[data-row]')].map(e => e.dataset.row)"
        )
        view = f"detector/{urllib.parse.quote(row, safe='')}"
    browser.open("about:blank")
    browser.open(f"{url}#/{view}")
    shown = "[...document.querySelectorAll('main h1')].some((e) => e.checkVisibility())"
    browser.wait_for(f"!document.querySelector('[aria-busy], [role=status]') && {shown}")


# -- the first view -------------------------------------------------------------------------------


def test_the_first_view_names_the_best_row_whose_it_is_when_and_how_to_take_part(browser, season):
    assert browser.text("#head h1") == "Season 2026-11"
    assert "Season 2026-11, 27 November 2026." in browser.text(".what")
    test = season.ranks.first[next(s.entry for s in season.ranks.standings if s.rank == 2)]
    headline = browser.text(".headline").replace("\N{MINUS SIGN}", "-")
    assert headline.startswith("Best: riqn by Danesh, Fern (2021), Benchmarks <b>, matched AUC ")
    assert f"It is told from the second, mine: the difference is {100 * test.difference:+.1f}" in (
        headline
    )
    assert f"[{100 * test.low:+.1f}, {100 * test.high:+.1f}]" in headline
    assert browser.texts("header nav a") == ["Home", "Board", "Submit", "Cite", "Source"]
    assert browser.texts("#boards label") == [
        "Season 2026-11", "Reported: mini (abababab)", "Reported: mini (cdcdcdcd)",
    ]  # fmt: skip
    browser.click(".proof summary")
    assert {"0123456789abcdef" * 2, "5e" * 32} <= set(browser.texts(".proof dd"))


def test_rows_stand_in_the_boards_order_with_five_columns(browser, season):
    standings = season.ranks.standings
    assert browser.texts(LABELS) == [str(s.entry) for s in standings]
    assert column_titles(browser) == ["Rank", "Detector", *FIVE]
    expected = [f"{s.rank or DASH}{'=' * s.equal}" for s in standings]
    assert browser.texts("#ranking tbody td.rank") == expected
    assert browser.texts("tr.band th > a") == [str(s.entry) for s in standings if s.band]
    assert browser.texts("tr.out th > a") == ["oracle", "broken"]
    badges = ["oracle", "the paper\u2019s", "others\u2019", "ours", "trivial", "others\u2019"]
    assert browser.texts("#ranking .badge") == badges
    assert "Not ranked: timeout in 2 of 8 cells" in browser.texts("#ranking .under.state")


def test_bold_are_the_best_of_ranked_rows_alone(browser, season):
    assert browser.texts("tr:is(.out, .trivial) strong") == []  # clock finds most within 20
    board = season.ranks.board
    means = {
        str(s.entry): board.mean(s.entry, board.environments, board.anomalies, "auc_matched").value
        for s in season.ranks.standings
        if s.rank
    }
    best = max(means, key=means.get)
    bold = browser.texts("#ranking tbody td:nth-child(3) strong")
    assert bold == [f"{100 * means[best]:.1f}"]


def test_with_one_environment_there_is_a_column_an_anomaly(browser):
    browser.choose("environment", "Hopper")
    kinds = ["IID", "Sensor Drift", "Gravity", "Agent's Components"]
    browser.wait_for("document.querySelectorAll('#ranking thead th').length === 10")
    assert column_titles(browser) == ["Rank", "Detector", FIVE[0], *kinds, *FIVE[2:]]
    assert any("Ranks are those over all cells" in line for line in browser.texts("#notes li"))
    assert browser.texts(".equal") == []


def test_everything_else_is_behind_one_button(browser, season):
    browser.click("#wide")
    titles = column_titles(browser)
    assert titles[2:7] == FIVE
    metrics = {name for r in season.ranks.board.records for name in r.metrics}
    assert len(titles) > len(metrics)
    assert {"Smoothed AUC", "Placebo", "Lowest seed", "Fit", "Sensor anomalies"} <= set(titles)
    assert browser.run("return document.activeElement.id") == "wide"
    browser.press("enter")
    assert column_titles(browser)[2:] == FIVE


def test_a_reported_table_has_no_ranks_and_says_what_it_is(browser):
    choose_board(browser, "Reported: mini (abababab)")
    assert browser.text("#head h1") == "Reported: mini (abababab)"
    assert browser.text("#head .notice") == REPORTED
    assert column_titles(browser) == ["Detector", *FIVE]
    assert browser.texts("#ranking strong") == []
    assert browser.text(".headline").startswith("Highest reported mean: riqn")
    assert "variant" in browser.texts("#ranking .badge")


def test_a_trial_says_in_its_title_that_it_is_no_board(window, tmp_path):
    trial = helpers_site.season(name="small", trial=True)
    window.open(written(tmp_path, (), (), [trial]))
    assert window.text("#head h1") == "Trial small: no board"
    assert window.text("#head .notice") == "This trial lacks environments ant, arm."


# -- the table ------------------------------------------------------------------------------------


def test_a_click_sorts_and_a_second_one_turns_round(browser):
    order = "return document.querySelector('[data-sort=worst]').closest('th').ariaSort"
    assert browser.run(order) == "none"
    browser.click("[data-sort=worst]")
    assert browser.run(order) == "descending"
    values = [float(text.split()[0]) for text in column(browser, FIVE[1]).values()]
    assert values == sorted(values, reverse=True)
    browser.click("[data-sort=worst]")
    assert [float(text.split()[0]) for text in column(browser, FIVE[1]).values()] == sorted(values)


def test_the_keyboard_sorts_reaches_every_control_and_opens_a_row(browser):
    browser.run("document.querySelector('[data-sort=label]').focus()")
    browser.press("enter")
    assert browser.texts(LABELS) == sorted(browser.texts(LABELS))
    assert browser.run("return document.activeElement.dataset.sort") == "label"
    browser.press("space")
    assert browser.texts(LABELS) == sorted(browser.texts(LABELS), reverse=True)
    browser.run("document.activeElement.blur(); scrollTo(0, 0)")
    browser.click(".name a")
    seen = []
    for _ in range(40):
        browser.press("tab")
        seen.append(
            browser.run(
                "const e = document.activeElement;"
                "return e.name || e.id || e.dataset.sort || e.textContent"
            )
        )
        if seen[-1] == "riqn" and "label" in seen:
            break
    for control in ("Submit", "board", "search", "environment", "anomaly", "wide", "rank",
                    "label", "auc_matched"):  # fmt: skip
        assert control in seen
    browser.press("enter")
    browser.wait_for("document.querySelector('#detector h1') !== null")
    assert browser.text("#detector h1").startswith("riqn")
    # The heading is announced, and the way back leads to the link that was followed.
    assert browser.run("return document.activeElement.tagName") == "H1"
    browser.press("shift+tab", "enter")
    browser.wait_for("document.querySelector('#detector').hidden")
    assert browser.run("return document.activeElement.textContent") == "riqn"


def test_means_and_intervals_are_the_boards_for_every_selection(browser, season):
    board = season.ranks.board
    environments = {"All environments": board.environments, "Hopper": ["hopper"]}
    kinds = {
        "All anomalies": board.anomalies,
        "Sensor anomalies": board.in_group("sensor"),
        **{ANOMALIES[a].title: [a] for a in ("iid", "gravity")},
    }
    columns = {"Matched AUC": "auc_matched", "False episodes": "false_episodes_at_5pct"}
    for (place, some), (name, anomalies) in itertools.product(environments.items(), kinds.items()):
        browser.choose("environment", place)
        browser.choose("anomaly", name)
        for title, metric in columns.items():
            found = column(browser, title)
            for standing in season.ranks.standings:
                value = board.mean(standing.entry, some, anomalies, metric, intervals=True)
                expected = show_value(value, metric).split(maxsplit=1)
                text = found[str(standing.entry)].replace("\n", " ").split(maxsplit=1)
                assert text == expected


def test_search_finds_names_authors_and_papers(browser):
    def search(text):
        browser.run(
            "const field = document.querySelector('[name=search]'); field.value = arguments[0];"
            "field.dispatchEvent(new Event('input'))", text
        )  # fmt: skip
        return browser.texts(LABELS)

    assert search("RIQ") == ["riqn"]
    assert search("eve") == ["mine", "rf"]
    assert search("benchmarks") == ["riqn"]
    assert search("the paper\N{RIGHT SINGLE QUOTATION MARK}s") == ["riqn"]
    assert search("no such") == []


def test_the_table_as_csv_has_its_rows(browser):
    lines = browser.run(
        """
        let text;
        window.Blob = class { constructor(parts) { text = parts.join(""); } };
        URL.createObjectURL = () => "#/";
        [...document.querySelectorAll("#filters .action")].at(-1).click();
        return text.trim().split("\\n");
        """
    )
    assert lines[0].startswith("Rank,Detector,Matched AUC")
    assert len(lines) == 7
    assert lines[2].startswith("1,riqn,")


def test_the_address_says_what_is_shown(browser):
    assert browser.run("return location.hash") == "#/"
    choose_board(browser, "Reported: mini (abababab)")
    browser.choose("environment", "Hopper")
    browser.choose("anomaly", "Sensor anomalies")
    browser.click("[data-sort^=missed]")
    address, caption = browser.run("return location.href"), browser.text("#ranking caption")
    labels = browser.texts(LABELS)
    browser.open("about:blank")
    browser.open(address)
    browser.wait_for("document.querySelector('#ranking') !== null")
    assert (browser.text("#ranking caption"), browser.texts(LABELS)) == (caption, labels)
    # Back from a row, the table is as it was left; the name of the site leads to the first view.
    open_row(browser, "rf")
    browser.click(".back a")
    browser.wait_for("document.querySelector('#detector').hidden")
    assert browser.text("#ranking caption") == caption
    browser.click(".name a")
    browser.wait_for("location.hash === '#/'")
    assert browser.text("#head h1") == "Season 2026-11"


@pytest.mark.parametrize(
    "wrong",
    [
        "?board=none&sort=<b>&wide=&environment=constructor",
        *("?anomaly=__proto__", "?%E0%A4%A", "detector/nobody", "compare/a/b", "<b>"),
    ],
)
def test_an_address_that_asks_for_what_is_not_there_is_a_table(browser, url, wrong):
    browser.open("about:blank")
    browser.open(f"{url}#/{wrong}")
    assert "riqn" in browser.texts(LABELS)
    assert browser.run("return document.querySelector('#detector').hidden")


# -- the page of a row ----------------------------------------------------------------------------


def test_a_rows_page_has_its_tests_cells_and_source(browser, season):
    open_row(browser, "mine")
    above = season.ranks.above[next(s.entry for s in season.ranks.standings if s.rank == 2)]
    lines = [line.replace("\N{MINUS SIGN}", "-").split("\t")
             for line in browser.texts("#tested tbody tr")]  # fmt: skip
    interval = f"[{100 * above.low:+.1f}, {100 * above.high:+.1f}]"
    assert lines[0][1:] == [f"{100 * above.difference:+.1f}", interval, "told apart"]
    assert lines[1][0] == "the first, riqn"
    # A name of a stranger is text, and the address of a script no link.
    assert browser.run("return document.querySelectorAll('main b').length") == 0
    facts = browser.texts("#source dd")
    assert {"<b>Eve</b>", "javascript:alert(1)", "mine-1.2-py3-none-any.whl", "12" * 32} <= {*facts}
    assert browser.run("return document.querySelectorAll('#source a').length") == 0
    assert "mine 1.2, SHA-256 121212121212" in facts
    headers = [text.replace("\n", " ") for text in browser.texts(".heat thead [scope=col]")]
    assert headers[1:] == ["IID", "Sensor Drift", "Gravity", "Agent's Components", "Mean"]
    assert any("no curves for this cell" in t for t in browser.texts("#cell .note"))
    browser.run("document.querySelectorAll('.heat td a')[7].focus()")
    browser.press("enter")
    browser.wait_for("document.querySelector('#cell h2').textContent.startsWith('Hopper')")
    assert browser.text("#cell h2") == "Hopper, Agent's Components"
    # The keyboard stays where it was.
    assert browser.run("return document.activeElement.getAttribute('aria-current')") == "true"
    browser.run("history.back()")
    browser.run("history.back()")
    browser.wait_for("document.querySelector('#detector').hidden")
    link = "return document.querySelector('[data-row$=riqn] .under a').outerHTML"
    assert 'href="https://example.org/page" rel="noopener noreferrer external"' in browser.run(link)


def test_heat_shows_every_cell_of_a_row(browser, season):
    board = season.ranks.board
    open_row(browser, "rf")
    (rf,) = [s.entry for s in season.ranks.standings if str(s.entry) == "rf"]
    shown = iter(browser.texts(".heat tbody td"))
    for some in [*([e] for e in board.environments), board.environments]:
        for anomalies in [*([a] for a in board.anomalies), board.anomalies]:
            value = board.mean(rf, some, anomalies, "auc_matched")
            assert next(shown) == show_value(value, "auc_matched")


KINDS = {"cartpole": ("iid", "gravity"), "hopper": ("drift", "components")}


def test_kinds_of_single_environments_stand_side_by_side_with_their_strengths(window, tmp_path):
    cells = [(e, a) for e, kinds in KINDS.items() for a in kinds]
    board = helpers_site.season(cells=cells, rows=("riqn", "clock"), strength="kept90")
    window.open(written(tmp_path, (), (), [board]))
    window.click(".proof summary")
    drawn = window.texts(".proof tbody td")
    assert drawn == ["iid@kept90", "gravity@kept90", "drift@kept90", "components@kept90"]
    open_row(window, "riqn")
    assert window.texts(".heat thead th") == ["Environment", "Sensor", "Dynamics", "Mean"]
    row = board.ranks.standings[0].entry
    means = [board.ranks.board.mean(row, [e], [a], "auc_matched") for e, a in cells]
    names = ["IID", "Gravity", "Sensor Drift", "Agent's Components"]
    assert [text.split("\n") for text in window.texts(".heat tbody td:has(a)")] == [
        [name, "kept90", show_value(mean, "auc_matched")]
        for name, mean in zip(names, means, strict=True)
    ]
    recorded, run = window.texts("#source code")
    assert recorded.split("--bits ")[1] == f"{board.season.bits} --output rebuilt"
    assert run == (
        "oodd-eval run --detector riqn --env cartpole,hopper --split rebuilt/split --seed 0,1,2"
    )


def test_curves_are_drawn_from_what_is_reported_and_played(browser, reported):
    source = next(s for s in reported[0].sources.values() if s.curves)
    units = read_curves(source.curves)["units"]
    (unit,) = [u for u in units if u["cell"].startswith("mini/hopper/gravity::riqn[h=1,")]
    choose_board(browser, "Reported: mini (abababab)")
    open_row(browser, "riqn")
    assert "Table 5" in browser.text("#paper caption")
    browser.run("location.hash += '/hopper/gravity'")
    browser.wait_for("document.querySelector('#cell h2').textContent === 'Hopper, Gravity'")
    example = unit["example"]
    assert len(browser.texts(".alarms.anomalous line")) == len(example["alarms"])
    assert len(browser.texts(".alarms.twin line")) == len(example["twin_alarms"])
    assert f"onset τ = {example['onset']}" in browser.texts(".onset text")
    # Every point of the ROC curve, and its corner, is on the line.
    path = browser.run("return document.querySelector('#cell .line.anomalous').getAttribute('d')")
    assert path.count("L") == len(unit["roc"]["fpr"])
    at = example["start"] + 3
    browser.run(
        "const slider = document.querySelector('.player input'); slider.value = arguments[0];"
        "slider.dispatchEvent(new Event('input'))", at
    )  # fmt: skip
    assert browser.text(".player output").startswith(f"t = {at}, {example['onset'] - at} before")
    browser.click(".player button")
    browser.wait_for(f"Number(document.querySelector('.player input').value) > {at}")
    browser.click(".player button")
    assert browser.text(".player button") == "Play"


# -- overviews ------------------------------------------------------------------------------------


def test_weaker_anomalies_are_drawn_over_strength_and_over_their_cost(browser):
    browser.run("location.hash = '#/power'")
    browser.wait_for("document.querySelector('#power') !== null")
    assert sorted(browser.texts("#power .legend li")) == ["rf", "riqn", "trivial rows"]
    paths = "return [...document.querySelectorAll('#power path')].map((p) => p.getAttribute('d'))"
    drawn = browser.run(paths)
    assert len(drawn) == 3
    for control in ("axis", "metric"):
        browser.run(
            "document.querySelectorAll(`[name='power-${arguments[0]}']`)[1].click()", control
        )
        assert browser.run(paths) != drawn
        assert browser.run("return document.activeElement.name") == f"power-{control}"
    browser.run("document.querySelector('[name=power-row][value=rf]').click()")
    assert browser.texts("#power .legend li") == ["riqn", "trivial rows"]


def test_quality_and_cost_are_points_that_lead_to_their_rows(browser, url):
    open_view(browser, url, "cost")
    labels = browser.texts("#costs tbody th a")
    assert labels == ["oracle", "riqn", "mine", "rf", "clock"]
    assert sorted(browser.texts(".spot text")) == sorted(labels)
    browser.run("document.querySelectorAll('.spot')[1].focus()")
    browser.press("enter")
    browser.wait_for("document.querySelector('#cells') !== null")
    assert browser.text("#detector h1").startswith("riqn")


@pytest.mark.parametrize("columns", ["anomaly", "environment", "cell"])
def test_the_map_of_cells_has_the_boards_numbers(browser, url, season, columns):
    open_view(browser, url, "heat")
    browser.run(
        "document.querySelector(`[name=heat-columns][value=${arguments[0]}]`).click()", columns
    )
    board = season.ranks.board
    wanted = {
        "anomaly": [(board.environments, [a]) for a in board.anomalies],
        "environment": [([e], board.anomalies) for e in board.environments],
        "cell": [([e], [a]) for e in board.environments for a in board.anomalies],
    }[columns]
    shown = iter(browser.texts("#heatmap tbody td"))
    for standing, (some, anomalies) in itertools.product(
        season.ranks.standings, [*wanted, (board.environments, board.anomalies)]
    ):
        value = board.mean(standing.entry, some, anomalies, "auc_matched")
        assert next(shown) == show_value(value, "auc_matched")


# -- all of it ------------------------------------------------------------------------------------

VIEWS = ["", "?wide=true", "?environment=hopper", "?board=BOARD", "power", "cost", "heat",
         "detector"]  # fmt: skip

NAMELESS = """
    const named = (e) => e.getAttribute("aria-label") || e.textContent.trim();
    const drawings = [...document.querySelectorAll("svg:not([aria-hidden])")]
      .filter((e) => !named(e));
    const tables = [...document.querySelectorAll("table:not(.numbers)")]
      .filter((e) => !e.caption || e.querySelector("th:not([scope])"));
    const titles = [...document.querySelectorAll("h1")].filter((e) => e.checkVisibility());
    return [...drawings, ...tables].map((e) => e.outerHTML.slice(0, 200))
      .concat(titles.length === 1 ? [] : [`${titles.length} titles`]);
"""
"""A script: what has no name and is not among what axe takes for serious."""

THEME = "return document.documentElement.dataset.theme"


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_every_page_can_be_read_at_every_width_and_in_every_colour(browser, url, width, theme):
    boards = browser.run("return JSON.parse(document.getElementById('data').text).boards")
    defects = {}
    with browser.colours(theme), browser.narrow(width):
        for view in VIEWS:
            open_view(browser, url, view.replace("BOARD", boards[1]["id"]))
            assert browser.run(THEME) == theme
            assert browser.texts("header nav a") == ["Home", "Board", "Submit", "Cite", "Source"]
            if lines := browser.defects(width) + browser.run(NAMELESS):
                defects[view] = lines
            browser.open(url)  # so that the next view finds the rows
            browser.wait_for("document.querySelector('[data-row]') !== null")
    assert defects == {}


def test_the_reader_of_defects_sees_them(window, tmp_path):
    page = tmp_path / "page.html"
    page.write_text(
        "<!doctype html><html><title>t</title><meta name='viewport' content='width=device-width'>"
        "<table><tr><td style='width: 2em; overflow-wrap: anywhere'>unbreakable</td></tr></table>"
        "<p style='width: 500px; color: #bbb'>pale</p></html>"
    )
    with window.narrow(390):
        window.open(page.as_uri())
        kinds = {defect.partition(":")[0] for defect in window.defects(390)}
    assert kinds == {"scrolls sideways", "broken", "color-contrast", "html-has-lang"}


def test_colours_follow_the_button_and_are_kept(browser, url):
    before = browser.run(THEME)
    browser.click("#theme")
    try:
        assert {before, browser.run(THEME)} == {"light", "dark"}
        # What one page stores reaches the next one late, now and then: it is opened until it has.
        until = time.monotonic() + 10
        kept = before
        while kept == before and time.monotonic() < until:
            browser.open("about:blank")
            browser.open(url)
            kept = browser.run(THEME)
        assert kept != before
    finally:
        browser.run("localStorage.removeItem('oodd-theme')")


def test_the_policy_stops_requests(window, url):
    window.open(url)
    window.requests()
    outcome = window.run(
        """
        const image = new Image();
        const result = new Promise((done) => {
          image.onload = image.onerror = (e) => done(e.type);
        });
        image.src = "https://example.org/x.png";
        const fetched = fetch("https://example.org/").then(() => "ok", () => "stopped");
        return Promise.all([result, fetched]);
        """
    )
    assert outcome == ["error", "stopped"]
    assert any("Content Security Policy" in message for message in window.console())


@pytest.mark.parametrize("width", [390, 1280])
def test_reported_logs_have_columns_of_their_own_and_no_twins(window, tmp_path, width):
    records = ResultsDirectory(ROOT / "leaderboard" / "suites" / "logs").records()
    of_split = [r for r in records if r.split.startswith("skab")]
    url = written(tmp_path, sections([Reported(tmp_path, of_split)]))
    window.open(url)
    with window.narrow(width):
        for view in ("", "?wide=true", "heat", "detector"):
            open_view(window, url, view)
            assert [line for line in window.defects(width) if "scrolls" in line] == []
            text = window.run("return document.querySelector('main').innerText").lower()
            text = text.partition("all metrics\n")[0].replace("without twins", "")
            assert "twin" not in text
            assert "matched" not in text
            window.open(url)
    titles = column_titles(window)
    assert titles[:2] == ["Detector", "Pooled AUC"]
    assert titles[-3:] == FIVE[2:]
    assert window.console() == []


def test_a_row_of_a_published_split_says_which_command_makes_it(window, tmp_path):
    digest = published_digests()["mini"]
    records = [make_record("riqn", seed=seed, overrides={"members": 5}, digest=digest)
               for seed in (0, 1)]  # fmt: skip
    other = [make_record("rf", digest="ab" * 32)]
    reported = sections([Reported(tmp_path, records), Reported(tmp_path / "other", other)])
    window.open(written(tmp_path, reported))
    open_row(window, "riqn[members=5]")
    (command,) = window.texts("#source code")
    assert command == (
        "oodd-eval run --detector riqn --env hopper --split mini --seed 0,1 --param members=5"
    )
    assert main([*shlex.split(command)[1:], "--collect-only"]) == 0
    window.run("history.back()")
    window.wait_for("document.querySelector('#detector').hidden")
    choose_board(window, "Reported: mini (abababab)")
    open_row(window, "rf")
    assert window.texts("#source code") == []  # others have no such split


def test_a_page_without_entries_says_so(window, tmp_path):
    window.open(written(tmp_path, []))
    assert "There are no entries yet." in window.texts("#overview .note")
    assert window.console() == []


def test_a_table_on_which_everything_failed_is_shown(window, tmp_path):
    record = helpers_site.make_record(status="oom", reason="needed 9 GB")
    window.open(written(tmp_path, sections([helpers_site.report(tmp_path, "one", [record])])))
    assert column(window, "Matched AUC") == {"riqn": "oom"}
    open_row(window, "riqn")
    assert window.text(".failure") == "oom: needed 9 GB"
    assert window.console() == []


def test_a_lost_data_file_is_named(window, season, tmp_path):
    url = written(tmp_path, (), (), [season])
    for file in (tmp_path / site.PARTS).glob("*.js"):
        file.unlink()
    window.open(url)
    assert "riqn" in window.texts(LABELS)
    window.run("document.querySelector('[name=environment]').value = 'hopper'")
    window.run("document.querySelector('[name=environment]').dispatchEvent(new Event('change'))")
    window.wait_for("document.querySelector('.failure') !== null")
    assert "oodd-eval leaderboard build" in window.text("[role=alert]")
    window.console()


def test_the_first_view_of_500_rows_takes_less_than_a_second(window, tmp_path):
    files = helpers_site.full(500)
    assert len(files[site.PAGE]) < 1_000_000
    large = helpers_site.write_site(tmp_path, files)
    walls, processors = [], []
    paint = "performance.getEntriesByName('first-contentful-paint')[0]"
    load = "performance.getEntriesByType('navigation')[0]"
    while len(walls) < 8 and min(walls, default=1.0) >= 1.0:
        window.open("about:blank")
        before = window.processor_seconds()
        window.open(large)
        window.wait_for(f"{paint} && {load}.loadEventEnd > 0")
        processors.append(window.processor_seconds() - before)
        # Until the page is drawn and its script has run, whichever is later.
        drawn = window.run(f"return Math.max({paint}.startTime, {load}.loadEventEnd)")
        walls.append(drawn / 1000)
    assert len(window.texts(LABELS)) == 100
    # Where other programs take the processors, what the page itself needs of them has to be little.
    assert min(walls) < 1.0 or 0.0 < min(processors) < 0.6, (walls, processors)
    window.click("#all")
    assert len(window.texts(LABELS)) == 500
