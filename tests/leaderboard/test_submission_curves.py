"""Entries with curves: refused where these are not sound."""

import json

import pytest
from helpers_submission import Draft


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
