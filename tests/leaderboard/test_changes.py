"""Pull requests of entries in a scratch repository: merged without conflict, and nothing beside."""

import shutil
import subprocess

import pytest
from oodd_leaderboard import pages as leaderboard_build
from oodd_leaderboard.commands.entries import changes_against
from oodd_leaderboard.submit import Statement, submit

from oodd_eval.cli.main import main
from oodd_eval.errors import UsageError


class Repository:
    """A checkout whose board has one entry, on the branch main."""

    def __init__(self, place):
        self.place, self.results = place, place / "leaderboard" / "results"
        self.results.mkdir(parents=True)
        (place / "README.md").write_text("A board.\n")
        (place / ".gitignore").write_text("/leaderboard/site/\n")
        self.git("init", "-q", "-b", "main")

    def git(self, *arguments):
        told = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
        done = subprocess.run(
            ["git", "-C", self.place, *told, *arguments],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def commit(self, message="change"):
        self.git("add", "-A")
        self.git("commit", "-q", "-m", message)

    def branch(self, name):
        self.git("switch", "-q", "-c", name, "main")

    def verify(self, *more):
        return main(
            ["leaderboard", "verify", str(self.results), "--changed-against", "main", *more]
        )

    def build(self, *more):
        output = str(self.results.parent)
        return main(["leaderboard", "build", str(self.results), "--output", output, *more])


@pytest.fixture(autouse=True)
def small_site(monkeypatch):
    """The site has tests of its own."""
    monkeypatch.setattr(leaderboard_build.site, "files", lambda *_, **__: {"index.html": "site"})


@pytest.fixture
def add(submissions):
    """Add an entry of one detector to a repository."""

    def added(repository, detector, **meta):
        made = submit(
            submissions.results, repository.results, Statement(id=f"{detector}-small", **meta),
            detectors=detector, curves="none", split=submissions.split,
        )  # fmt: skip
        assert made.verdict.ok
        return made.path

    return added


@pytest.fixture
def repository(tmp_path, submissions):
    made = Repository(tmp_path / "checkout")
    shutil.copytree(submissions.plain, made.place / "elsewhere")
    made.commit("start")
    return made


def test_two_entries_of_two_branches_merge_and_the_board_has_both(repository, add, capsys):
    for detector in ("persistence", "random"):
        repository.branch(detector)
        add(repository, detector)
        repository.commit(detector)
        capsys.readouterr()
        assert repository.verify() == 0
        assert f"{detector}-small: may be merged" in capsys.readouterr().out
    repository.git("switch", "-q", "main")
    repository.git("merge", "-q", "--no-edit", "persistence", "random")
    assert repository.build() == 0
    page = (repository.results.parent / "README.md").read_text()
    assert "### persistence-small" in page
    assert "### random-small" in page
    repository.commit("board")
    assert "site" not in repository.git("ls-files", "leaderboard")
    assert repository.build("--check") == 0
    # The next entry makes the committed board old, which is no matter of its pull request.
    repository.branch("next")
    shutil.rmtree(repository.results / "random-small")
    repository.commit("next")
    assert repository.build("--check") == 1
    assert repository.verify() == 0


def test_an_entry_counts_before_it_is_committed(repository, add):
    add(repository, "random")
    (repository.place / "my-notes.txt").write_text("not known to git, and not of the pull request")
    assert changes_against("main", repository.results) == (["random-small"], [])
    assert repository.verify() == 0


@pytest.mark.parametrize(
    "path", ["README.md", "leaderboard/README.md", "leaderboard/results/x.txt"]
)
def test_nothing_else_is_changed_with_an_entry(repository, add, path, capsys):
    repository.branch("mine")
    add(repository, "random")
    (repository.place / path).write_text("{}\n")
    repository.commit()
    assert repository.verify() == 1
    said = capsys.readouterr()
    assert f"{path}: is changed together with an entry" in said.out
    assert "and nothing else: take the files above out of it" in said.err


def test_changes_without_an_entry_are_not_looked_at(repository, capsys):
    repository.branch("code")
    (repository.place / "README.md").write_text("Another.\n")
    repository.commit()
    assert repository.verify() == 0
    assert "no entry differs from main" in capsys.readouterr().out


def test_what_main_changed_since_is_no_part_of_the_pull_request(repository, add):
    repository.branch("mine")
    add(repository, "random")
    repository.commit()
    repository.git("switch", "-q", "main")
    (repository.place / "README.md").write_text("Main went on.\n")
    repository.commit()
    repository.git("switch", "-q", "mine")
    assert repository.verify() == 0


def test_an_entry_that_is_not_valid_is_refused(repository, add, capsys):
    repository.branch("mine")
    place = add(repository, "random")
    (place / "records.jsonl").write_text("{}\n")
    repository.commit()
    assert repository.verify() == 1
    assert "refused: 1 of 1 entry" in capsys.readouterr().err


def test_an_entry_that_copies_another_one_is_refused(repository, add, capsys):
    add(repository, "random")
    repository.commit()
    repository.branch("mine")
    place = repository.results / "mine"
    shutil.copytree(repository.results / "random-small", place)
    entry = place / "entry.json"
    entry.write_text(entry.read_text().replace('"id": "random-small"', '"id": "mine"'))
    repository.commit()
    assert repository.verify() == 1
    assert "is of a row of entry random-small too" in capsys.readouterr().out


@pytest.mark.parametrize("base", ["nowhere", "--help"])
def test_a_base_that_is_no_commit_is_refused(repository, base):
    with pytest.raises(UsageError, match="rev-parse says"):
        changes_against(base, repository.results)


def test_a_directory_that_is_no_checkout_is_refused(tmp_path):
    (tmp_path / "results").mkdir()
    with pytest.raises(UsageError, match="expected a checkout"):
        changes_against("main", tmp_path / "results")


def test_the_option_goes_with_no_other_check(tmp_path, capsys):
    given = ["leaderboard", "verify", str(tmp_path), "--changed-against", "main", "--split", "mini"]
    assert main(given) == 4
    assert "--changed-against is for one directory" in capsys.readouterr().err
