"""Seeds of a re-run: drawn once for one version of an entry, and for what they are drawn."""

import dataclasses
import json

import pytest
from helpers_submission import assert_refused
from oodd_recording.rerun import check_installed, definition_of, draw, environments_of, plan_of
from test_submission_trust import entry, fresh, of_three  # noqa: F401  fixtures

from oodd_eval.cli import main as cli
from oodd_eval.data.facts import CUSTOM_SEED_BASES, ENVIRONMENTS, SPLITS
from oodd_eval.data.split import load_split
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.leaderboard.entry import read_entry
from oodd_eval.leaderboard.verify import verify_entry
from oodd_eval.leaderboard.verify.rerun import ORDER, read_order
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.slow

NAMES = ["acrobot", "cartpole", "hopper"]


@pytest.fixture
def read(entry, tmp_path):  # noqa: F811
    return read_entry(of_three(entry, tmp_path).path)


def on(read, split):
    return dataclasses.replace(read, meta=dataclasses.replace(read.meta, split=split))


def test_seeds_are_drawn_once_and_stay(read, tmp_path):
    assert read_order(tmp_path / "again") is None
    first = draw(read, tmp_path / "again", NAMES, sandbox=True)
    assert first.seed_base in CUSTOM_SEED_BASES
    assert first == draw(read, tmp_path / "again", NAMES, sandbox=True)
    assert first == read_order(tmp_path / "again")
    others = {draw(read, tmp_path / str(k), NAMES, sandbox=True).seed_base for k in range(9)}
    assert len(others) > 3


def test_one_plain_worker_is_enough_for_the_mark(read, tmp_path):
    assert str(draw(read, tmp_path, NAMES, sandbox=True)).endswith("in a sandbox")
    assert str(draw(read, tmp_path, NAMES, sandbox=False)).endswith("without a sandbox")
    assert str(draw(read, tmp_path, NAMES, sandbox=True)).endswith("without a sandbox")


def test_seeds_count_for_one_version_of_an_entry(read, tmp_path, fresh):  # noqa: F811
    drawn = draw(read, tmp_path / "again", NAMES, sandbox=True)
    records = ResultsDirectory(fresh).records()
    verdict = verify_entry(read.path, rerun=records, order=drawn)
    assert verdict.reached == "re-run"
    assert f"seed base {drawn.seed_base} drawn on {drawn.day} for this entry" in verdict.rerun.how
    assert "by the verifier's word" in verify_entry(read.path, rerun=records).rerun.how
    changed = json.loads((read.path / "entry.json").read_text()) | {"title": "Another"}
    (read.path / "entry.json").write_text(json.dumps(changed))
    verdict = verify_entry(read.path, rerun=records, order=drawn)
    assert_refused(verdict, "entry", "seeds were drawn for another version of the entry")
    with pytest.raises(UsageError, match="seeds are drawn for one version of an entry"):
        draw(read_entry(read.path), tmp_path / "again", NAMES, sandbox=True)


def test_other_environments_need_another_directory(read, tmp_path):
    draw(read, tmp_path, NAMES, sandbox=True)
    with pytest.raises(UsageError, match="on acrobot, cartpole, hopper, expected hopper"):
        draw(read, tmp_path, ["hopper"], sandbox=True)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"schema": 2}', "\x00", "{" * 9999])
def test_a_damaged_order_is_told(tmp_path, text):
    (tmp_path / ORDER).write_text(text)
    with pytest.raises(ResultsError, match="is no order of a re-run"):
        read_order(tmp_path)


def test_the_split_is_the_entrys_but_for_the_seeds(read, tmp_path):
    drawn = draw(read, tmp_path, NAMES, sandbox=True)
    assert environments_of(read) == [name for name in ENVIRONMENTS if name in NAMES]
    made = definition_of(on(read, "mini"), drawn)
    assert made.seed_base == drawn.seed_base
    assert (
        dataclasses.replace(made, name="mini", seed_base=SPLITS["mini"].seed_base)
        == (SPLITS["mini"])
    )
    for split in ("three@01234567", "ladder"):
        with pytest.raises(UsageError, match="expected one that can be recorded with other seeds"):
            definition_of(on(read, split), drawn)


def test_a_plan_has_the_rows_and_seeds_of_the_entry(read):
    plan = plan_of(read, load_split("mini"), discover())
    assert {(u.environment, u.setting.detector, u.seed) for u in plan.units} == {
        (name, "persistence", 0) for name in NAMES
    }
    assert len(plan.cells) == 24
    with pytest.raises(UsageError, match="has none of seeds 7"):
        plan_of(read, load_split("mini"), discover(), [7])


@pytest.mark.parametrize("field", ["detector_version", "plugin_source", "plugin"])
def test_another_version_of_the_plug_in_is_not_run(read, field):
    check_installed(read, discover())
    records = [dataclasses.replace(r, **{field: "e" * 64}) for r in read.records]
    with pytest.raises(UsageError, match=r"is installed as .*, but .* has .*: install that"):
        check_installed(dataclasses.replace(read, records=records), discover())


def test_only_a_valid_entry_is_run(read, tmp_path, capsys):
    (read.path / "more").write_text("")
    command = ["leaderboard", "rerun", str(read.path), "--output", str(tmp_path / "again")]
    assert cli.main(command) == 4
    assert "expected one valid entry" in capsys.readouterr().err
    assert not (tmp_path / "again").exists()
