"""Pages of the site from files outside of docs/, and links that work on both sides.

ProperDocs calls these functions while it builds (``hooks`` in properdocs.yml). Pages that live
beside what they describe, such as the detectors' READMEs, become pages of the site, and pages on
environments are built. A link to a file that has no page leads into the repository, if
pyproject.toml says where that is, or becomes its path in it.
"""

import html
import json
import os
import re
from pathlib import Path, PurePosixPath

import click
from figures import environments
from latex2mathml.converter import convert
from oodd_leaderboard import site
from oodd_leaderboard.pages import CELLS, cells, read_leaderboard
from properdocs.config.defaults import ProperDocsConfig
from properdocs.structure import StructureItem
from properdocs.structure.files import File, Files
from properdocs.structure.nav import Navigation
from properdocs.structure.pages import Page

from oodd_eval._version import repository
from oodd_eval.cli import ALL
from oodd_eval.cli.main import PROGRAM

ROOT = Path(__file__).resolve().parents[1]
DOCS = "docs/"

ELSEWHERE = (
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "detectors/**/*.md",
    "examples/**/*.md",
    "leaderboard/README.md",
    "leaderboard/reproduction/*/README.md",
    "leaderboard/reproduction/*/figures/*",
    "leaderboard/reproduction/*/*.csv",
    "leaderboard/reproduction/*/tables/*.csv",
    "leaderboard/tables/*.csv",
    "recording/README.md",
)
"""Files outside docs/ that are part of the site, under the same paths."""

BOARD = "leaderboard/site"
SITE = "site/index.html"
RESULTS = ("leaderboard/README.md", f"leaderboard/{SITE}")
"""Pages of the leaderboard; absent before the first entry."""

FENCE = re.compile(r"^(```.*?^```[^\n]*$)", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)\s#:]+)(#[^)\s]*)?\)")
MATHS = re.compile(r"^\$\$(.+?)\$\$$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![^\s>-])(?=[^\s<-]*\d)[^\sA-Za-z<>-]+(?![^\s<-])")
"""A word with digits and without letters, where the search splits its index."""
COMMANDS = "<!-- help of every command -->"
WORD = re.compile(r"<code>([^<\s]{1,24})</code>")
"""A short name as code, which a line should not break at its hyphens."""
PARAGRAPH = re.compile(r"<p>(.*?)</p>", re.DOTALL)
SENTENCES = re.compile(r"(?<=[.?!]) ")

LLMS = "llms.txt"
"""Index of the pages for language models, as https://llmstxt.org has it."""


def elsewhere() -> list[str]:
    """Repository paths of the site's files outside docs/."""
    found = (path for pattern in ELSEWHERE for path in sorted(ROOT.glob(pattern)))
    return [path.relative_to(ROOT).as_posix() for path in found]


def on_config(config: ProperDocsConfig) -> ProperDocsConfig:
    """Link to the repository, if it has an address, and leave out results while there are none."""
    config.repo_url = config.repo_url or repository() or None
    missing = set() if (ROOT / RESULTS[0]).exists() else set(RESULTS)
    config.nav = _without(config.nav or [], missing)
    return config


def _without(entries: list, missing: set[str]) -> list:
    """Entries of a navigation whose files are there: paths, and titles with a path or a section."""
    kept = []
    for entry in entries:
        if isinstance(entry, dict):
            ((title, target),) = entry.items()
            if isinstance(target, list):
                kept.append({title: _without(target, missing)})
            elif target not in missing:
                kept.append(entry)
        elif entry not in missing:
            kept.append(entry)
    return kept


def on_files(files: Files, config: ProperDocsConfig) -> Files:
    """Add the pages that live elsewhere, and those that are built."""
    for path in elsewhere():
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    pages = {f"{environments.NAME}/{name}": content for name, content in environments.built()}
    for path, content in (board() | pages).items():
        if written := files.get_file_from_path(path):  # by hand, perhaps of older strengths
            files.remove(written)
        files.append(File.generated(config, path, content=content))
    return files


def on_nav(nav: Navigation, config: ProperDocsConfig, files: Files) -> Navigation:
    """Keep the navigation, from which the index for language models is written at the end."""
    del files
    config.extra[LLMS] = nav
    return nav


def on_page_content(content: str, page: Page, config: ProperDocsConfig, files: Files) -> str:
    """Describe a page by its first sentences, and keep names such as ``pe-a`` on one line."""
    del config, files
    content = WORD.sub(r'<code class="word">\1</code>', content)
    texts = (_plain(paragraph) for paragraph in PARAGRAPH.findall(content))
    first, *others = SENTENCES.split(next((text for text in texts if text.count(" ") > 2), ""))
    while others and len(first) < 50:
        first += " " + others.pop(0)
    page.meta.setdefault("description", f"{first[:-1]}." if first.endswith(":") else first)
    return content


def _plain(text: str) -> str:
    """Return the text of HTML in one line, without the word that opens a decision."""
    plain = " ".join(html.unescape(re.sub(r"<[^>]+>", "", text)).split())
    return plain.removeprefix("Context. ")


def on_post_build(config: ProperDocsConfig) -> None:
    """Write the index for language models, and mend that of the search."""
    index = llms(config.extra.pop(LLMS), config)
    (Path(config.site_dir) / LLMS).write_text(index, encoding="utf-8")
    _mend_search(Path(config.site_dir) / "search" / "search_index.json")


def llms(nav: Navigation, config: ProperDocsConfig) -> str:
    """Return the text of llms.txt: each page with address, title and first sentence."""
    base = config.site_url or ""
    sections: dict[str, list[str]] = {}

    def add(item: StructureItem, section: str) -> None:
        for child in item.children or ():
            add(child, section if item.parent else item.title)
        if not item.children:
            description = item.meta.get("description", "") if isinstance(item, Page) else ""
            line = f"- [{item.title}]({base}{item.url})"
            sections.setdefault(section, []).append(line + f": {description}" * bool(description))

    for item in nav.items:
        add(item, "Start")
    lists = [f"## {title}\n\n" + "\n".join(lines) for title, lines in sections.items()]
    return "\n\n".join([f"# {config.site_name}", f"> {config.site_description}", *lists]) + "\n"


def _mend_search(path: Path) -> None:
    """Take numbers, half of all words, out of the search's index.

    lunr writes a node of its tree as letters that are followed by numbers of other nodes, so that
    words with digits may be taken for others, and then searches fail:
    https://github.com/olivernn/lunr.js/issues/314 has the symptom.
    """
    index = json.loads(path.read_text(encoding="utf-8"))
    for entry in index["docs"]:
        entry["text"] = NUMBER.sub(" ", entry["text"])
    path.write_text(json.dumps(index, separators=(",", ":")), encoding="utf-8")


def board() -> dict[str, str | bytes]:
    """Return the files of the leaderboard's site, which are not committed."""
    if not (ROOT / RESULTS[0]).exists():
        return {}
    board = read_leaderboard(ROOT / "leaderboard")
    # Pages of Markdown that it links to are pages of this site.
    pages = {"home": "index", "submit": "submitting", "cite": "cite"}
    links = {name: f"../../{page}.html" for name, page in pages.items()}
    links["source"] = repository()
    shown = site.files(board.reported, board.suites, board.seasons, links=links)
    page = shown[site.PAGE].replace('href="../README.md"', 'href="../index.html"')
    files = {**shown, site.PAGE: page, Path(CELLS).name: cells(board)}
    return {f"{BOARD}/{name}": content for name, content in files.items()}


def on_page_markdown(markdown: str, page: Page, config: ProperDocsConfig, files: Files) -> str:
    """Turn links, formulas and marks of built parts into what the site shows."""
    del config
    pictures = {file.src_uri.removeprefix(f"{environments.NAME}/") for file in files}
    markdown = environments.with_tables(markdown, pictures)
    outside = {*elsewhere()}
    source = page.file.src_uri
    source = source if source in outside else DOCS + source
    shown = [file.src_uri for file in files if file.inclusion.is_included()]
    pages = {uri if uri in outside else DOCS + uri: uri for uri in shown}

    def outside_of_code(text: str) -> str:
        text = LINK.sub(lambda found: _link(found, source, page.file.src_uri, pages), text)
        return MATHS.sub(lambda found: convert(found[1].strip(), display="block"), text)

    parts = FENCE.split(markdown)
    parts[::2] = map(outside_of_code, parts[::2])
    text = "".join(parts).replace(COMMANDS, _commands() if COMMANDS in markdown else "")
    # The board's page is also read where its site is not built, so that it has no link itself.
    return text.replace(f"`{SITE}`", f"[{SITE}]({SITE})") if source == RESULTS[0] else text


def _link(found: re.Match[str], source: str, uri: str, pages: dict[str, str]) -> str:
    """Return a link of a page as the site has it; one that leads nowhere stays, for a warning."""
    text, target, anchor = found[1], found[2], found[3] or ""
    path = os.path.normpath(PurePosixPath(source).parent / target)
    if path == "README.md":
        path = DOCS + "index.md"
    for page in (path, f"{path}/README.md"):
        if page in pages:
            return f"[{text}]({os.path.relpath(pages[page], PurePosixPath(uri).parent)}{anchor})"
    if (ROOT / path).exists():
        if address := repository():
            return f"[{text}]({address}/blob/HEAD/{path}{anchor})"
        return text if path in text else f"{text} (`{path}`)"
    return found[0]


def _commands() -> str:
    """Help texts of all commands, a section each."""
    sections: list[str] = []

    def add(context: click.Context) -> None:
        path = context.command_path
        level = "#" * (1 + len(path.split()))
        sections.append(f"{level} {path}\n\n```text\n{context.get_help().rstrip()}\n```")
        if isinstance(group := context.command, click.Group):
            for name in group.list_commands(context):
                add(click.Context(group.get_command(context, name), context, info_name=name))

    # Narrow enough for a page, whatever the terminal is.
    program = click.Context(PROGRAM, info_name="oodd-eval", terminal_width=80)
    program.meta[ALL] = True
    add(program)
    return "\n\n".join(sections)
