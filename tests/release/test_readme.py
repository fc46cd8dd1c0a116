"""The README's commands and the names in the documents cannot rot."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml
from helpers_docs import parse

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")),
             *sorted((ROOT / "detectors").rglob("*.md"))]  # fmt: skip


def commands():
    return dict(re.findall(r"<!-- command: (\w+) -->\n```sh\n(.*?)\n```", README, re.DOTALL))


def test_extras_in_the_commands_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    named = re.findall(r'-e "\.\[(.*?)\]"', README)
    assert len(named) >= 2
    assert all(extra in extras for group in named for extra in group.split(","))


def test_the_readme_is_read_in_three_minutes():
    assert len(README.split()) <= 700


@pytest.mark.docs
def test_the_first_command_prints_the_table_below_it(tmp_path, monkeypatch, capsys):
    from oodd_eval.cli.main import main

    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)
    assert main(commands()["start"].split("oodd-eval ", 1)[1].split()) == 0
    block = README.partition("<!-- command: start -->")[2].partition("```text\n")[2]
    assert block.partition("```")[0] in capsys.readouterr().out


def test_main_command_selects_cells():
    from oodd_eval.cli.main import main

    arguments = commands()["main"].split("oodd-eval ", 1)[1].split()
    assert main([*arguments, "--collect-only", "-q"]) == 0


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_relative_links_lead_somewhere(path):
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", path.read_text()):
        assert (path.parent / target).exists(), f"{path.name} links to {target}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_in_documents_parse(path, capsys):
    blocks = "\n".join(re.findall(r"```(?:sh|console)\n(.*?)```", path.read_text(), re.DOTALL))
    for line in re.findall(r"^(?:\$ )?(oodd-eval [^\n|`]*)$", blocks, re.MULTILINE):
        if "--config" not in line:  # a file that the page shows
            parse(line)


def test_commands_without_installing_run_the_wheel_of_this_version():
    from oodd_eval import __version__

    lines = re.findall(
        r"^(?:uvx|pipx) .*$", (ROOT / "docs/how-to/install.md").read_text(), re.MULTILINE
    )
    assert len(lines) == 4
    for line in lines:
        words = shlex.split(line)
        source = words[words.index("--from" if words[0] == "uvx" else "--spec") + 1]
        assert f"/oodd_eval-{__version__}-py3-none-any.whl" in source
        assert re.match(r"\./|oodd-eval\[\w+\] @ https://", source)
        parse(shlex.join(words[words.index("oodd-eval") :]))


def test_the_citation_is_one_by_its_schema():
    """Keys, and those that are required, of the Citation File Format 1.2.0."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    further = {"abstract", "commit", "contact", "date-released", "doi", "identifiers", "keywords",
               "license", "license-url", "preferred-citation", "references", "repository",
               "repository-artifact", "repository-code", "type", "url", "version"}  # fmt: skip
    assert set(citation) <= {"cff-version", "message", "title", "authors"} | further
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] in {"software", "dataset"}
    for reference in citation["references"]:
        assert {"authors", "title", "type"} <= set(reference)
        assert all(i["type"] in {"doi", "other", "swh", "url"} for i in reference["identifiers"])
    for author in (*citation["authors"], *citation["references"][0]["authors"]):
        assert set(author) in ({"name"}, {"given-names", "family-names"})


def test_citations_have_the_version():
    from oodd_eval import __version__

    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == __version__
    cite = (ROOT / "docs" / "cite.md").read_text()
    assert f"version = {{{__version__}}}" in cite
    assert (
        f"oodd_eval-{__version__}-py3-none-any.whl" in (ROOT / "docs/how-to/install.md").read_text()
    )
