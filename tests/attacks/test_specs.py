"""What a plug-in may say of its detectors: a wrong spec breaks its plug-in, and nothing else."""

import re

import pytest
from helpers_plugins import install
from oodd_logs.readers import Reader, check_reader

from oodd_eval import DetectorSpec, evaluate
from oodd_eval.cli import main as cli
from oodd_eval.errors import PluginError, UnknownNameError
from oodd_eval.plugins.discovery import discover

OFFERS = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Known:
    größe: int = 3

@hookimpl
def oodd_detectors():
    return [DetectorSpec("fine", Good, ""), DetectorSpec(**({{"name": "odd", "factory": Good,
            "summary": ""}} | {{{changed}}}))]
"""

NAMES = {
    "number": "5", "bytes": "b'x'", "empty": "''", "path": "'../../etc'", "end": "'a\\n'",
    "escape": "'\\x1b[31mred'", "zero-width": "'r\\u200bf'", "look-alike": "'\\u0440f'",
    "digits": "'\\u0661'", "capital": "'RF'", "long": "'x' * 300", "comma": "'a,b'",
    "hyphen": "'-a'", "two-colons": "'a:B:C'", "list": "['rf']",
}  # fmt: skip
FIELDS = {
    "factory": "'factory': 3", "summary": "'summary': 3",
    "summary-lines": "'summary': 'a\\nb'", "summary-escape": "'summary': '\\x1b]0;x\\x07'",
    "summary-long": "'summary': 'x' * 10**6", "reference": "'reference': b'x'",
    "inputs": "'inputs': 'labels'", "inputs-list": "'inputs': ['observations']",
    "alarm": "'alarm': 'never'", "deterministic": "'deterministic': 'no'",
    "other": "'other_parameters': 1", "decides": "'horizon_decides_fit': None",
    "requires": "'requires': 'torch'", "requires-numbers": "'requires': (3,)",
    "version": "'version': '1\\n2'", "version-path": "'version': '../1'", "fit": "'fit_name': 3",
    "extra": "'extra': 'a\\rb'", "parameters": "'parameters': {'size': 3}",
    "parameters-names": "'parameters': Known",
}  # fmt: skip


@pytest.mark.parametrize(
    "changed", [f"'name': {name}" for name in NAMES.values()] + [*FIELDS.values()],
    ids=[f"name-{name}" for name in NAMES] + [*FIELDS],
)  # fmt: skip
def test_a_wrong_spec_is_told_and_the_others_go_on(changed, monkeypatch, tmp_path, capsys):
    install(monkeypatch, tmp_path, "odd", OFFERS.format(changed=changed))
    plugins = discover()
    assert {"rf", "clock"} <= plugins.offers.keys()
    assert not {"odd", "fine"} & plugins.offers.keys()
    (broken,) = plugins.broken
    assert broken.plugin == "odd"
    field = changed.split("'")[1]
    assert re.match(rf"PluginError: {field} of a DetectorSpec is .*, expected ", broken.reason)
    assert len(broken.reason) < 400
    assert broken.reason.isprintable()
    assert cli.main(["list", "detectors"]) == 1
    out, err = capsys.readouterr()
    assert "clock" in out
    assert "[broken plug-in] PluginError" in " ".join((out + err).split())
    with pytest.raises(UnknownNameError):
        plugins.offer("fine")


STOPS = """
class Text(str):
    def __format__(self, spec): raise SystemExit("format")
    def __eq__(self, other): raise SystemExit("equal")
    def __hash__(self): raise SystemExit("hash")
    def __repr__(self): raise SystemExit("repr")
    def isprintable(self): return True

class Mute(Exception):
    def __str__(self): raise SystemExit("mute")

class Endless(list):
    def __iter__(self):
        while True: yield DetectorSpec("odd", Good, "")

class Spec(DetectorSpec):
    def __getattribute__(self, name): raise SystemExit(name)

def endless():
    while True: yield DetectorSpec("odd", Good, "")

Shown = type("Shown", (), {"__repr__": lambda self: sys.exit("shown")})

@hookimpl
def oodd_detectors(): return [DetectorSpec("fine", Good, ""), *first()]
def first(): @RETURNS@
"""
RETURNED = {
    "text": "return [DetectorSpec(Text('odd'), Good, '')]",
    "subclass": "return [Spec('odd', Good, '')]",
    "no-spec": "return [Shown()]",
    "mute": "raise Mute",
    "exit": "sys.exit(Shown())",
    "cancelled": "raise GeneratorExit",
    "default": "return [DetectorSpec('odd', Good, '', parameters=declared_by({'a': Shown()}))]",
    "many-parameters": "return [DetectorSpec('odd', Good, '', parameters=declared_by("
    "dict.fromkeys(map('a{}'.format, range(999)))))]",
    "many": "return [DetectorSpec(f'odd-{i}', Good, '') for i in range(5000)]",
}


@pytest.mark.parametrize("returns", RETURNED.values(), ids=RETURNED)
def test_a_hook_that_stops_those_who_ask_breaks_its_plug_in(returns, monkeypatch, tmp_path, capsys):
    install(monkeypatch, tmp_path, "odd", STOPS.replace("@RETURNS@", returns))
    assert cli.main(["list", "detectors"]) == 1
    out, _ = capsys.readouterr()
    assert {"rf", "clock"} <= {line.split()[0] for line in out.splitlines() if line.strip()}
    assert "[broken plug-in]" in out
    assert "fine" not in out.split()


@pytest.mark.parametrize(
    "hook", ["oodd_environments", "oodd_anomalies", "oodd_readers", "oodd_detectors"]
)
@pytest.mark.parametrize("returned", ["Endless()", "endless()", "[Shown()]", "Text()"])
def test_what_is_no_list_of_specs_breaks_its_plug_in(hook, returned, monkeypatch, tmp_path):
    code = STOPS.replace("@RETURNS@", "return []")
    if hook == "oodd_detectors":
        code = code.partition("@hookimpl")[0]
    install(monkeypatch, tmp_path, "odd", f"{code}\n@hookimpl\ndef {hook}(): return {returned}\n")
    plugins = discover()
    if hook == "oodd_readers":
        plugins.offered_by(hook, Reader, check_reader)
    else:
        assert plugins.custom_specs is not None
    assert "clock" in plugins.offers
    assert [broken.plugin for broken in plugins.broken] == ["odd"]


@pytest.mark.parametrize("raises", ["SystemExit", "RuntimeError"])
def test_what_is_required_is_not_imported(raises, monkeypatch, tmp_path, capsys):
    (tmp_path / "parent").mkdir()
    (tmp_path / "parent" / "__init__.py").write_text(f"raise {raises}")
    code = """
        @hookimpl
        def oodd_detectors(): return [DetectorSpec("odd", Good, "", requires=("parent.child",))]
    """
    install(monkeypatch, tmp_path, "odd", code)
    assert cli.main(["list", "detectors"]) == 0
    assert "odd " in capsys.readouterr().out


@pytest.mark.parametrize("name", [5, "a\nb"])
def test_a_wrong_name_of_a_detector_of_ones_own(name, tiny_split):
    with pytest.raises(PluginError, match="name of a DetectorSpec is"):
        evaluate(DetectorSpec(name, object, ""), tiny_split)


@pytest.mark.parametrize("name", ["a:B\\n", "a:" + "b" * 300, "a:.b", ":b"])
def test_a_wrong_name_made_for_a_colon(name, monkeypatch, tmp_path):
    code = f"""
        @hookimpl
        def oodd_detector_from_spec(spec): return DetectorSpec("{name}", Good, "")
    """
    install(monkeypatch, tmp_path, "odd", code)
    with pytest.raises(PluginError, match="name of a DetectorSpec is"):
        discover().offer("odd:one")
