"""The documentation site: it builds without a network, is whole, and shows what is true."""

import html.parser
import importlib.metadata
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path
from pkgutil import resolve_name

import helpers_browser
import numpy as np
import pytest
import yaml
from helpers_docs import ROOT

pytestmark = pytest.mark.docs

DOCS = ROOT / "docs"
FIGURES = DOCS / "figures"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site; whatever ProperDocs warns of is an error."""
    directory = tmp_path_factory.mktemp("site")
    # Its theme advertises on the terminal.
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, "-m", "properdocs", "build", "--strict", "--site-dir", directory],
        cwd=ROOT, env=env, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return directory


LOADING = {"script": "src", "img": "src", "iframe": "src", "source": "src", "embed": "src",
           "object": "data", "video": "src", "audio": "src"}  # fmt: skip
"""Elements that load something, and the attribute that says what."""


class Page(html.parser.HTMLParser):
    """What a page loads, where it links to, and the places in it that can be linked to."""

    def __init__(self, text):
        super().__init__()
        self.loads, self.links, self.places, self.text = [], [], set(), []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        told = dict(attributes)
        if tag in LOADING and told.get(LOADING[tag]):
            self.loads.append(told[LOADING[tag]])
        # Of links, only what tells where a page belongs loads nothing.
        if tag == "link" and told.get("rel") not in {"canonical", "next", "prev"}:
            self.loads.append(told.get("href", ""))
        if tag == "a" and told.get("href"):
            self.links.append(told["href"])
        self.places |= {told[key] for key in ("id", "name") if told.get(key)}

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def pages(site):
    found = {path: Page(path.read_text()) for path in sorted(site.rglob("*.html"))}
    # The leaderboard's page has tests of its own, and 404.html is served from anywhere.
    board = site / "leaderboard" / "site"
    return {p: x for p, x in found.items() if board not in p.parents and p.name != "404.html"}


def test_every_document_is_a_page(site):
    sources = [p.relative_to(DOCS) for p in sorted(DOCS.rglob("*.md"))]
    beside = [p for d in ("detectors", "recording") for p in sorted((ROOT / d).rglob("*.md"))]
    outside = [p.relative_to(ROOT) for p in beside]
    built = [p.with_name("index.md") if p.name == "README.md" else p for p in (*sources, *outside)]
    missing = [p for p in built if not (site / p.with_suffix(".html")).is_file()]
    assert not missing
    assert len(built) > 30


def test_no_page_is_twice_in_the_navigation():
    navigation = (ROOT / "properdocs.yml").read_text().partition("\nnav:\n")[2]
    pages = re.findall(r"\S+\.(?:md|html)$", navigation, re.MULTILINE)
    assert sorted(pages) == sorted({*pages})


def test_the_index_for_language_models_describes_every_page_of_the_navigation(site):
    """llms.txt: a title, a summary, and lists of links with what the page is about."""
    title, summary, *sections = (site / "llms.txt").read_text().split("\n\n")
    assert title == "# oodd-eval"
    assert summary.startswith("> Evaluation harness and leaderboard")
    navigation = (ROOT / "properdocs.yml").read_text().partition("\nnav:\n")[2]
    sources = re.findall(r"\S+\.(?:md|html)$", navigation, re.MULTILINE)
    lines = "\n".join(part for part in sections if not part.startswith("## ")).splitlines()
    links = [re.fullmatch(r"- \[(.+)\]\(([^()]+)\)(?:: (.{20,}))?", line) for line in lines]
    built = [re.sub(r"(README)?\.md$", lambda m: "index.html" if m[1] else ".html", source)
             for source in sources]  # fmt: skip
    assert sorted(link[2] for link in links) == sorted(built)  # single pages come first
    assert all((site / link[2]).is_file() for link in links)
    bare = [link[2] for link in links if not link[3]]
    assert bare == ["leaderboard/site/index.html"]  # which is no page of Markdown
    (datasheet,) = (link for link in links if link[2] == "datasheet.html")
    assert datasheet[3].startswith("What the published splits are made of")
    assert not any(link[3] and link[3].endswith(":") for link in links)


def test_every_page_is_reached_from_the_home_page(site, pages):
    seen, new = set(), [site / "index.html"]
    while new:
        page = new.pop()
        seen.add(page)
        targets = {(page.parent / link.partition("#")[0]).resolve() for link in pages[page].links}
        new += [target for target in targets if target in pages and target not in seen | {*new}]
    assert seen == set(pages)


def test_no_page_loads_anything_from_elsewhere(site, pages):
    for path, page in pages.items():
        for address in page.loads:
            assert "//" not in address, f"{path.relative_to(site)} loads {address}"
            assert (path.parent / address).is_file(), f"{path.relative_to(site)} misses {address}"


def test_no_stylesheet_loads_anything_from_elsewhere(site):
    sheets = sorted(site.rglob("*.css"))
    assert sheets
    for sheet in sheets:
        text = sheet.read_text()
        found = re.findall(r"@import\s+[\"']?([^\"';]+)|url\(\s*[\"']?([^\"')]+)", text)
        addresses = [a or b for a, b in found]
        assert not [a for a in addresses if not a.startswith("data:") and "//" in a]


def test_links_between_pages_lead_to_their_places(site, pages):
    resolved = {path.resolve(): page for path, page in pages.items()}
    for path, page in pages.items():
        for link in page.links:
            if re.match(r"[a-z]+:", link):
                assert link.startswith("https:"), f"{path.relative_to(site)} links to {link}"
                continue
            file, _, place = link.partition("#")
            target = (path.parent / file).resolve() if file else path.resolve()
            where = f"{path.relative_to(site)} links to {link}"
            assert target.is_file(), where
            if place and target in resolved:
                assert place in resolved[target].places, where


def test_links_out_of_docs_lead_to_pages_of_the_site(pages, site):
    assert "detectors/index.html" in " ".join(pages[site / "tutorial.html"].links)
    assert "../tutorial.html" in pages[site / "detectors" / "index.html"].links


def test_reference_has_every_public_name(site):

    import oodd_eval

    text = "".join(p.read_text() for p in (site / "reference").glob("*.html"))
    names = {*oodd_eval.__all__} - {"__version__", "hookimpl", "live"}
    missing = {n for n in names if not re.search(rf'id="oodd_\w+\.[\w.]*{n}"', text)}
    assert not missing
    for hook in ("detectors", "detector_from_spec"):
        assert f'id="oodd_eval.plugins.oodd_{hook}"' in text
    for hook in ("run_started", "cell_finished", "run_finished"):
        assert f'id="oodd_eval.scoring.observers.oodd_{hook}"' in text


def test_reference_shows_the_help_of_every_command(pages, site):
    from oodd_eval.cli.main import COMMANDS

    text = "".join(pages[site / "reference" / "commands.html"].text)
    assert "help of every command -->" not in text
    for command, (_, target) in ((c, row) for rows in COMMANDS.values() for c, row in rows.items()):
        assert f"Usage: oodd-eval {command} " in text
        actions = () if isinstance(target, str) else target
        assert all(f"Usage: oodd-eval {command} {action} " in text for action in actions)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    directory = tmp_path_factory.mktemp("figures")
    subprocess.run([sys.executable, FIGURES / "make.py", directory], check=True)
    return directory


NUMBER = re.compile(r"-?\d+\.\d+|-?\d+")


def test_figures_are_what_the_script_draws(drawn):
    pinned = re.search(r"^matplotlib==(.*)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    if importlib.metadata.version("matplotlib") != pinned[1]:
        pytest.skip("another matplotlib draws the same figure in another way")
    names = {path.name for path in drawn.iterdir()}
    # interventions.py draws the other one, from cells that are not committed.
    assert names == {path.name for path in FIGURES.glob("*.svg")} - {"intervention.svg"}
    for name in sorted(names):
        new, old = (Path(d, name).read_text() for d in (drawn, FIGURES))
        # Processors differ in last digits of scores: ids, which are digests, and fractions of
        # points may differ, the picture may not.
        shapes = [re.sub(r'(?<=[#"])m[0-9a-f]{10}', "", text) for text in (new, old)]
        assert NUMBER.sub("", shapes[0]) == NUMBER.sub("", shapes[1]), name
        points = [np.array([float(x) for x in NUMBER.findall(shape)]) for shape in shapes]
        assert np.abs(points[0] - points[1]).max() < 1, name


def test_figures_of_the_protocol_are_all_shown_and_described():
    shown = re.findall(r"!\[([^\]]+)\]\(figures/(\w+)\.svg\)", (DOCS / "protocol.md").read_text())
    drawn = {path.stem for path in FIGURES.glob("*.svg")}
    assert {figure for _, figure in shown} == drawn - {"intervention", "power", "shutdown"}
    assert "(figures/intervention.svg)" in (DOCS / "interventions.md").read_text()
    assert "(figures/shutdown.svg)" in (DOCS / "index.md").read_text()
    assert "(docs/figures/shutdown.svg)" in (ROOT / "README.md").read_text()
    assert "(../figures/power.svg)" in (DOCS / "results/ladder.md").read_text()
    assert all(len(described) > 30 for described, _ in shown)


def shown_functions(page):
    """Functions and methods that a page of the reference shows, by name."""
    for name, options in re.findall(r"^::: (\S+)\n((?: {4}.*\n)*)", page + "\n", re.MULTILINE):
        members = (yaml.safe_load(options) or {}).get("options", {}).get("members")
        found = resolve_name(name)
        if inspect.isfunction(found):
            yield name, found
            continue
        home = found.__module__ if inspect.isclass(found) else name
        for one, item in list(vars(found).items()):
            wanted = one in members if members is not None else not one.startswith("_")
            member = getattr(item, "__func__", item)
            if not wanted or getattr(member, "__module__", "") != home:
                continue
            if inspect.isclass(member):
                own = {k: getattr(v, "__func__", v) for k, v in vars(member).items()}
                yield from ((f"{one}.{k}", v) for k, v in own.items()
                            if inspect.isfunction(v) and not k.startswith("_"))  # fmt: skip
            elif inspect.isfunction(member):
                yield f"{name}.{one}", member


def test_every_function_of_the_reference_names_its_parameters():
    pages = [path.read_text() for path in sorted(DOCS.glob("reference/*.md"))]
    functions = [pair for page in pages for pair in shown_functions(page)]
    assert len(functions) > 20
    wrong = {}
    for name, function in functions:
        section = re.search(
            r"^Parameters\n-+\n(.*?)(?:\n\n\w+\n---|\Z)",
            inspect.getdoc(function) or "",
            re.DOTALL | re.MULTILINE,
        )
        named = re.findall(
            r"^\**(\w+(?:, \w+)*)(?: :.*)?$", section[1] if section else "", re.MULTILINE
        )
        documented = {one for names in named for one in names.split(", ")}
        expected = {*inspect.signature(function).parameters} - {"self", "cls"}
        if documented != expected:
            wrong[name] = sorted(documented ^ expected)
    assert not wrong


@pytest.mark.skipif(helpers_browser.programs() is None, reason="no Chromium and chromedriver")
def test_site_works_from_disk_in_a_browser(site, tmp_path):
    with helpers_browser.launch(tmp_path) as browser:
        browser.open("about:blank")
        browser.requests()
        for page in ("index.html", "protocol.html", "reference/detector.html"):
            browser.open((site / page).as_uri())
            browser.wait_for("document.readyState === 'complete'")
            shown = browser.run("return [...document.images].every((i) => i.naturalWidth > 0)")
            assert shown, page
        browser.run(
            "const input = document.querySelector('.md-search__input');"
            "document.querySelector('[data-md-toggle=search]').click();"
            "input.value = 'matched AUC';"
            "input.dispatchEvent(new KeyboardEvent('keyup', { bubbles: true }));"
        )
        browser.wait_for("document.querySelectorAll('.md-search-result__item').length > 3", 30)
        assert browser.console() == []
        asked = [url for url in browser.requests() if not url.startswith(("file:", "data:"))]
        assert [url for url in asked if not url.startswith(("about:", "chrome:"))] == []


IN_DARK = ("index", "tutorial", "metrics", "results", "environments/hopper", "reference/detector")
"""Pages that between them have everything that has a colour."""


@pytest.mark.skipif(helpers_browser.programs() is None, reason="no Chromium and chromedriver")
def test_every_page_can_be_read_on_a_telephone(site, pages, tmp_path):
    dark = [(site / name).with_suffix(".html") for name in IN_DARK]
    defects = {}
    with helpers_browser.launch(tmp_path) as browser, browser.narrow(390):
        for theme, scheme, paths in (("light", "default", pages), ("dark", "slate", dark)):
            with browser.colours(theme):
                browser.open((site / "index.html").as_uri())
                browser.run("localStorage.clear()")  # the theme keeps the colours of the first page
                for path in paths:
                    browser.open(path.as_uri())
                    browser.wait_for("document.querySelector('.md-search[aria-label]')")
                    assert browser.run("return document.body.dataset.mdColorScheme") == scheme
                    if lines := browser.defects(390, "tbody tr:nth-child(n + 6)"):
                        defects[theme, str(path.relative_to(site))] = lines
    assert defects == {}
