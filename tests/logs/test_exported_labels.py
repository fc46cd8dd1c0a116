"""An export of a split of logs keeps its labels."""

import dataclasses
import json

import minari
from helpers_logs import UNPAIRED, make_log_split

from oodd_eval import load_split
from oodd_eval.cli.main import main


def test_labels_of_logs_are_metadata_of_an_export(tmp_path, monkeypatch):
    facts = dataclasses.replace(UNPAIRED, offsets=(5.4e6, 0.0, 0.0), licence="CC BY 4.0")
    slips = [((30, 45),), ((10, 20), (30, 40)), ((-1, 12),), ()]
    logs = make_log_split(tmp_path / "arm", facts, anomalies={"slip": slips})
    root = tmp_path / "datasets"
    assert main(["data", "export", str(logs), "--format", "minari", "--output", str(root)]) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    dataset = minari.load_dataset("oodd/arm/arm/test-slip-v0")
    metadata = list(dataset.storage.get_episode_metadata(range(4)))
    assert [json.loads(m["intervals"]) for m in metadata] == [[[30, 45]], [[10, 20], [30, 40]],
                                                              [[-1, 12]], []]  # fmt: skip
    assert {m["anomaly"] for m in metadata} == {"slip"}
    episode = load_split(logs).environment("arm").labelled("slip")[1]
    assert (next(dataset.iterate_episodes([1])).observations == episode.observations).all()
    facts = json.loads((root / "oodd/arm/arm/train-v0/data/metadata.json").read_text())["logs"]
    assert (facts["licence"], facts["offsets"]) == ("CC BY 4.0", [5.4e6, 0, 0])
