"""Entries with scores and curves: recomputed where they are sound, refused where they are not."""

import json

import h5py
import numpy as np
import pytest
from helpers_submission import Draft, assert_refused

KEY = "scores/persistence-cartpole-"
"""How the one score file's name begins."""


def scores_file(d):
    (path,) = d.file("scores").iterdir()
    return path


def inside(change):
    """Change the score file by a function of the opened file."""

    def tamper(d):
        with h5py.File(scores_file(d), "r+") as file:
            change(file)

    return tamper


def number(part, at, value):
    def change(file):
        file[part]["scores"][at] = value

    return inside(change)


def replaced(name, **options):
    """Replace a dataset by another."""

    def change(file):
        del file[name]
        file.create_dataset(name, **options)

    return inside(change)


def cut_off(d):
    path = scores_file(d)
    path.write_bytes(path.read_bytes()[:-2000])


def overwritten(content):
    return lambda d: scores_file(d).write_bytes(content)


def unknown_file(d):
    d.file("scores/other.h5").write_bytes(scores_file(d).read_bytes())
    d.entry["files"]["scores/other.h5"] = {}


def kept_elsewhere(file):
    n = len(file["calibration/scores"])
    del file["calibration/scores"]
    file.create_dataset(
        "calibration/scores", (n,), "f8", external=[("/etc/hostname", 0, h5py.h5f.UNLIMITED)]
    )


def virtual(file):
    n = len(file["calibration/scores"])
    del file["calibration/scores"]
    layout = h5py.VirtualLayout((n,), "f8")
    layout[:] = h5py.VirtualSource("/tmp/other.h5", "x", (n,))  # noqa: S108  never opened
    file.create_virtual_dataset("calibration/scores", layout)


def linked(link):
    def change(file):
        del file["calibration/scores"]
        file["calibration/scores"] = link

    return inside(change)


def objects(file):
    del file["calibration/scores"]
    file.create_dataset("calibration/scores", data=["x"] * 5, dtype=h5py.string_dtype())


def shorter(file):
    """Take the last score of the last calibration trajectory away, consistently."""
    scores, offsets = file["calibration/scores"][:-1], file["calibration/offsets"][:]
    offsets[-1] -= 1
    del file["calibration/scores"], file["calibration/offsets"]
    file["calibration/scores"], file["calibration/offsets"] = scores, offsets


SCORES = {
    "changed-score": (number("test/iid", 50, 99.0), "metrics.auc.value"),
    "changed-calibration": (number("calibration", 5, 99.0), "metrics.far_twin.value"),
    "infinite-score": (number("test/iid", 50, np.inf), "test/iid/scores"),
    "undefined-in-the-middle": (number("test/iid", 50, np.nan), "test/iid/scores"),
    "undefined-too-long": (number("test/iid", slice(0, 30), np.nan), "test/iid/scores"),
    "other-lengths": (inside(shorter), "scores"),
    "single-precision": (
        replaced("calibration/scores", data=np.zeros(9, np.float32)), "calibration/scores",
    ),
    "objects": (inside(objects), "calibration/scores"),
    "bomb": (
        replaced(
            "calibration/scores", shape=(10**9,), dtype="f8", chunks=(10**6,), compression="gzip"
        ),
        "calibration/scores",
    ),
    "other-filter": (
        replaced("calibration/scores", data=np.zeros(9), compression="lzf"), "calibration/scores",
    ),
    "offsets-that-fall": (
        replaced("calibration/offsets", data=np.array([0, 50, 20])), "calibration/scores",
    ),
    "external-link": (linked(h5py.ExternalLink("/etc/passwd", "/x")), "points elsewhere"),
    "soft-link": (linked(h5py.SoftLink("/test")), "points elsewhere"),
    "kept-elsewhere": (inside(kept_elsewhere), "calibration/scores"),
    "virtual": (inside(virtual), "calibration/scores"),
    "missing-part": (inside(lambda f: f.__delitem__("test/drift")), "test/drift"),
    "cut-off": (cut_off, KEY),
    "pickle-as-scores": (overwritten(b"\x80\x04K\x01."), KEY),
    "of-no-record": (unknown_file, "scores/other.h5"),
}  # fmt: skip


@pytest.mark.parametrize("case", SCORES)
def test_tampered_scores_are_refused_by_their_field(submissions, tmp_path, case):
    tamper, field = SCORES[case]
    draft = Draft(submissions.full, tmp_path)
    tamper(draft)
    draft.write()
    verdict = draft.verdict(submissions.split)
    assert not verdict.ok
    assert any(field in problem.text for problem in verdict.findings.problems)


def test_an_entry_whose_scores_are_gone_is_one_that_is_reported(submissions, tmp_path):
    draft = Draft(submissions.full, tmp_path)
    path = scores_file(draft)
    path.unlink()
    path.parent.rmdir()
    del draft.entry["files"][f"scores/{path.name}"]
    assert draft.verdict(submissions.split).reached == "reported"


def curves(change):
    """Change the content of ``curves.json``."""

    def tamper(d):
        content = json.loads(d.file("curves.json").read_text())
        change(content)
        d.file("curves.json").write_text(json.dumps(content))

    return tamper


def unit(**changes):
    return curves(lambda c: c["units"][0].update(changes))


CURVES = {
    "rate-above-one": (
        curves(lambda c: c["units"][0]["roc"]["tpr"].__setitem__(3, 1.5)), "units[0].roc.tpr[3]",
    ),
    "unknown-field": (unit(code="x"), "units[0].code"),
    "unit-twice": (curves(lambda c: c["units"].append(c["units"][0])), "units[8].cell"),
    "not-a-number": (
        curves(lambda c: c["units"][0]["roc"]["tpr"].__setitem__(3, float("nan"))), "curves.json",
    ),
    "schema": (curves(lambda c: c.update(schema=2)), "schema"),
}  # fmt: skip


@pytest.mark.parametrize("case", CURVES)
def test_tampered_curves_are_refused_by_their_field(submissions, tmp_path, case):
    tamper, field = CURVES[case]
    draft = Draft(submissions.full, tmp_path)
    tamper(draft)
    verdict = draft.verdict(submissions.split)
    assert not verdict.ok
    assert any(field in problem.text for problem in verdict.findings.problems)


def test_scores_confirm_every_metric(submissions):
    from oodd_leaderboard.verify import verify_entry

    verdict = verify_entry(submissions.full, split=submissions.split)
    assert verdict.ok
    assert verdict.rescored
    assert any("qualifies for 're-scored'" in note for note in verdict.findings.notes)


@pytest.mark.parametrize("name", ["auc_matched", "far", "missed_at_10pct", "delay_null"])
def test_scores_catch_a_consistent_lie(submissions, tmp_path, name):
    draft = Draft(submissions.full, tmp_path)
    record = draft.records[0]
    top = record["per_trajectory"][name][0]
    top[0] = 0.0 if top[0] else 1.0
    draft.consistent(0, name)
    verdict = draft.verdict(submissions.split)
    assert_refused(verdict, f"metrics.{name}.value", "but the scores give")


def test_without_the_split_nothing_is_recomputed_and_this_is_said(submissions, tmp_path):
    draft = Draft(submissions.full, tmp_path)
    verdict = draft.verdict()
    assert verdict.ok
    assert not verdict.rescored
    assert "nothing recomputed" in " ".join(verdict.findings.notes)


def test_a_split_of_another_digest_is_not_used(submissions, tmp_path, tiny_split):
    draft = Draft(submissions.full, tmp_path)
    verdict = draft.verdict(tiny_split)
    assert not verdict.rescored
    assert any("here has digest" in note for note in verdict.findings.notes)
