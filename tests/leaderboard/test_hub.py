"""Results for hubs of models: read again by the hub's own library, and those of the board."""

import dataclasses

import pytest
import yaml
from oodd_leaderboard import hub
from oodd_leaderboard.reported import read_entry

from oodd_eval.cli import main as cli
from oodd_eval.errors import UsageError
from oodd_eval.results.board import boards
from oodd_eval.results.identity import Setting

METRICS = ["auc_matched", "delay_censored_at_5pct", "false_episodes_at_5pct"]


@pytest.fixture
def written(submissions, tmp_path):
    entry = read_entry(submissions.plain)
    meta = dataclasses.replace(entry.meta, url="https://example.org/trivial")
    entry = dataclasses.replace(entry, meta=meta)
    hub.write(entry, tmp_path, "lovelace/oodd-small")
    return entry, tmp_path


def expected(entry, detector, metric):
    """The mean as the board's tables have it; shares in percent."""
    (board,) = boards(entry.records)
    value = board.mean(Setting(detector, 1), board.environments, board.anomalies, metric).value
    return pytest.approx(value if metric.startswith("delay") else 100 * value, abs=0.005)


def test_each_detector_has_results_in_both_formats(written):
    entry, directory = written
    for detector in ("persistence", "random"):
        text = (directory / detector / ".eval_results" / "oodd-eval-small").with_suffix(".yaml")
        results = yaml.safe_load(text.read_text())
        for result in results:
            # Keys of the hub's eval_results.yaml, of which dataset and value are required.
            assert set(result) == {"dataset", "value", "date", "source", "notes"}
            metric = result["dataset"]["task_id"]
            assert result["value"] == expected(entry, detector, metric)
            assert result["dataset"]["id"] == "lovelace/oodd-small"
            assert result["source"]["url"] == "https://example.org/trivial"
            assert entry.meta.split_digest[:12] in result["notes"]
            assert "reported by its author" in result["notes"]
        # Of 20 calibration episodes there are alarms at 10 %, and none at 5 %.
        assert "auc_matched" in [result["dataset"]["task_id"] for result in results]
        assert {result["dataset"]["task_id"] for result in results} <= set(METRICS)
        _, head, card = (directory / detector / "README.md").read_text().split("---\n")
        (model,) = yaml.safe_load(head)["model-index"]
        assert model["name"] == detector
        (result,) = model["results"]  # of one environment there is no second one to name
        assert {m["type"]: m["value"] for m in result["metrics"]} == {
            r["dataset"]["task_id"]: r["value"] for r in results
        }
        assert f"entry {entry.meta.id}" in card


def test_the_library_of_the_hub_reads_the_same(written):
    library = pytest.importorskip(
        "huggingface_hub", reason="it is among the dependencies of development (extra dev)"
    )
    entry, directory = written
    text = (directory / "persistence" / ".eval_results" / "oodd-eval-small.yaml").read_text()
    results = library.parse_eval_result_entries(yaml.safe_load(text))
    values = {result.task_id: result.value for result in results}
    assert values["auc_matched"] == expected(entry, "persistence", "auc_matched")
    assert {result.source_url for result in results} == {"https://example.org/trivial"}
    card = library.ModelCard.load(directory / "persistence" / "README.md")
    assert card.data.model_name == "persistence"
    assert {r.metric_type: r.metric_value for r in card.data.eval_results} == values
    assert {r.dataset_type for r in card.data.eval_results} == {"lovelace/oodd-small"}


def test_a_row_that_lacks_cells_has_no_results(submissions, tmp_path):
    entry = read_entry(submissions.plain)
    lacking = [r for r in entry.records if (r.detector, r.anomaly) != ("random", "iid")]
    assert len(lacking) == len(entry.records) - 1
    hub.write(dataclasses.replace(entry, records=lacking), tmp_path, "lovelace/oodd-small")
    assert [path.name for path in tmp_path.iterdir()] == ["persistence"]


def test_submit_writes_them_beside_the_entry(submissions, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    submit = ["leaderboard", "submit", str(submissions.results), "--results", "entries"]
    submit += ["--split", str(submissions.split), "--id", "mine"]
    assert cli.main([*submit, "--hub", "no id"]) == 4
    assert "expected a data set's id on the hub: OWNER/NAME" in capsys.readouterr().err
    assert not (tmp_path / "entries").exists()
    assert cli.main([*submit, "--hub", "lovelace/oodd-small"]) == 0
    assert "hub-mine/persistence/README.md" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "hub-mine").iterdir()) == [
        "persistence", "random"
    ]  # fmt: skip
    # The entry itself has no more files than others have.
    assert not list((tmp_path / "entries" / "mine").rglob("*.yaml"))


@pytest.mark.parametrize("name", ["mini", "a/b/c", "a b/c", "/c", "a/", "ä/b"])
def test_ids_of_other_shapes_are_refused(name):
    with pytest.raises(UsageError, match="OWNER/NAME"):
        hub.check_dataset(name)


def test_mappings_lists_and_texts_of_any_content_are_read_again():
    value = [
        {"a": 'x: "y" # z', "b": {"c": "- \u00e9'\\", "d": None, "e": True}, "f": 98.82},
        {"g": [{"h": 1, "i": [{"j": "no"}]}, {"h": "2026-11-27"}]},
    ]
    assert yaml.safe_load("\n".join(hub._yaml(value))) == value
