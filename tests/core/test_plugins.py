"""Discovery: what is broken harms nobody else, and is named; plug-ins are loaded when named."""

import re
from dataclasses import dataclass

import pytest
from helpers_plugins import install
from oodd_trivial import Clock

from oodd_eval.errors import MissingExtraError, PluginError, UnknownNameError, UsageError
from oodd_eval.plugins.contract import DetectorSpec
from oodd_eval.plugins.discovery import Offer, discover, offer_of
from oodd_eval.plugins.parameters import declared_by, parameter, parameters_of, resolve_parameters

OFFER = """
@hookimpl
def oodd_detectors():
    return offer({name}=Good)
"""
BUILT_IN = {"random", "persistence", "clock", "comb", "range", "mahalanobis", "manifold"}


def broken(plugins):
    """Load everything, and return what is broken."""
    assert plugins.offers
    return plugins.broken


def test_an_installed_plugin_is_found_with_its_origin_beside_those_that_are_built_in(
    monkeypatch, tmp_path
):
    install(monkeypatch, tmp_path, "extra", OFFER.format(name="extra"), version="2.5")
    plugins = discover()
    offer = plugins.offer("extra")
    assert (offer.origin, offer.plugin, offer.module) == ("oodd-extra 2.5", "extra", "oodd_extra")
    assert set(plugins.offers) >= BUILT_IN
    offer = plugins.offer("clock")
    assert (offer.plugin, offer.distribution) == ("trivial", "oodd-eval")
    monkeypatch.setenv("OODD_EVAL_PLUGINS", "extra")
    assert set(discover().offers) == {"extra", *BUILT_IN}


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("raise RuntimeError('not today')", "RuntimeError: not today"),
        ("import sys; sys.exit(3)", "SystemExit: 3"),
        ("class Odd(BaseException): pass\nraise Odd('on purpose')", "Odd: on purpose"),
        (
            "class Mute(Exception):\n    def __str__(self): raise ValueError\nraise Mute",
            r"Mute: \(no message\)",
        ),
        ("def f(:", "SyntaxError"),
        ("@hookimpl\ndef oodd_detectors(): return [1]", r"returned \[1\], expected a list of oodd"),
        ("@hookimpl\ndef oodd_detectors(): return 1 / 0", "ZeroDivisionError"),
        ("@hookimpl\ndef oodd_detector(): return []", "unknown hook 'oodd_detector'"),
        ("@hookimpl\ndef oodd_run_start(): return []", "did you mean 'oodd_run_started'"),
        ("@hookimpl\ndef oodd_detectors(nothing): pass", "nothing"),
    ],
)
def test_a_broken_plugin_is_named_and_the_others_work(monkeypatch, tmp_path, code, reason):
    install(monkeypatch, tmp_path / "a", "aaa", code)
    install(monkeypatch, tmp_path / "b", "zzz", OFFER.format(name="zzz"))
    plugins = discover()
    (found,) = [b for b in broken(plugins) if b.plugin == "aaa"]
    assert found.distribution == "oodd-aaa"
    assert re.search(reason, found.reason)
    assert {"zzz", "clock"} <= set(plugins.offers)
    assert "aaa" not in plugins.loaded
    with pytest.raises(PluginError, match=f"'aaa' cannot be loaded: .*{reason}"):
        offer_of("aaa", "anything")


def test_a_plugin_that_is_not_named_is_not_imported(monkeypatch, tmp_path):
    for name in ("aaa", "zzz"):
        install(monkeypatch, tmp_path, name, "raise SystemExit('imported')")
    install(monkeypatch, tmp_path, "mine", OFFER.format(name="mine"))
    plugins = discover()
    assert plugins.select("mine,clock") == ["mine", "clock"]
    assert plugins.broken == []
    # No entry point has this name: all are loaded, one after the other, until it is found.
    with pytest.raises(UnknownNameError, match="unknown detector 'yours'"):
        plugins.select("yours")
    assert [b.plugin for b in plugins.broken] == ["aaa", "zzz"]


@pytest.mark.parametrize("patterns", ["all", "c*", "clock,min[ae]"])
def test_for_a_glob_everything_is_loaded(monkeypatch, tmp_path, patterns):
    install(monkeypatch, tmp_path, "aaa", "raise SystemExit('imported')")
    install(monkeypatch, tmp_path, "named", OFFER.format(name="mine"))
    plugins = discover()
    assert "clock" in plugins.select(patterns)
    assert "mine" in plugins.offers
    assert [b.plugin for b in plugins.broken] == ["aaa"]


def test_broken_plugins_are_reported_when_they_are_found(monkeypatch, tmp_path):
    for name in ("aaa", "zzz"):
        install(monkeypatch, tmp_path, name, "raise ValueError")
    heard, plugins = [], discover()
    with pytest.raises(UnknownNameError):
        plugins.offer("nosuch")
    plugins.report_broken_to(lambda found: heard.append(found.plugin))
    assert heard == ["aaa", "zzz"]
    with plugins.blaming(next(iter(plugins.loaded.values())).point):
        raise SystemExit
    assert heard == ["aaa", "zzz", plugins.broken[-1].plugin]


def test_nothing_of_a_failed_plugin_stays(monkeypatch, tmp_path):
    code = "@hookimpl\ndef oodd_detectors(): return [*offer(fine=Good), *offer(clock=Good)]"
    install(monkeypatch, tmp_path, "half", code)
    plugins = discover()
    assert "fine" not in plugins.offers
    assert plugins.offer("clock").distribution == "oodd-eval"
    assert "half" not in plugins.loaded


@pytest.mark.parametrize(
    ("names", "detector", "parts"),
    [
        (["one", "two"], "same", ["'same'", "'one' of oodd-one", "'two' of oodd-two"]),
        (["trivial"], "mine", ["oodd-eval has a plug-in of the same name"]),
    ],
)
def test_what_is_offered_twice_names_both_distributions(
    monkeypatch, tmp_path, names, detector, parts
):
    for name in names:
        install(monkeypatch, tmp_path / name, name, OFFER.format(name=detector))
    (found,) = broken(discover())
    assert found.distribution == f"oodd-{names[-1]}"
    assert all(part in found.reason for part in parts)


@pytest.mark.parametrize("name", ["aardvark", "clock"])
def test_no_other_distribution_takes_a_built_in_name(monkeypatch, tmp_path, name):
    install(monkeypatch, tmp_path, name, OFFER.format(name="clock"))
    plugins = discover()
    assert plugins.offer("clock").spec.factory is Clock
    assert [b.plugin for b in broken(plugins)] == [name]


@pytest.mark.parametrize("arguments", [{"disabled": ["nosuch"]}, {"only": ["nosuch"]}])
def test_restricting_to_what_is_not_installed_is_an_error(arguments):
    with pytest.raises(UnknownNameError, match="unknown plug-in 'nosuch'"):
        discover(**arguments)


def spec_requiring(*modules, extra=""):
    spec = DetectorSpec("x", Clock, "", requires=modules, extra=extra)
    return Offer(spec, "x", "oodd_x", "oodd-x", "1.0")


def test_what_is_missing_is_named_with_the_command_that_helps():
    assert spec_requiring("numpy", "os.path").unavailable() == ""
    assert "pip install no_such.part" in spec_requiring("no_such.part").unavailable()
    offer = spec_requiring("numpy", "no_such", extra="oodd-eval[reference]")
    assert offer.unavailable() == 'needs no_such: pip install "oodd-eval[reference]"'
    with pytest.raises(MissingExtraError, match="detector 'x' needs no_such"):
        offer.require()


@dataclass(frozen=True)
class Known:
    members: int = parameter(5, low=1, high=9)
    rate: float | None = parameter(None, low=0, decides="scores")
    kind: str = parameter("a", choices=("a", "b"))


def test_parameters_are_defaults_and_overrides():
    found = resolve_parameters("x", Known, {"members": 2})
    assert list(found.items()) == [("kind", "a"), ("members", 2), ("rate", None)]
    assert resolve_parameters("x", None, {"any": 1}, others=True) == {"any": 1}
    assert parameters_of(None) == {}
    values = {"size": 3, "kind": "a", "rate": None}
    declared = parameters_of(declared_by(values))
    assert {name: p.default for name, p in declared.items()} == values
    assert resolve_parameters("x", declared_by(values), values) == values


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        *(({"members": value}, "a whole number") for value in ("five", True, None, 2.5)),
        ({"members": 0}, "at least 1"),
        ({"members": 10}, "at most 9"),
        ({"rate": float("nan")}, "at least 0"),
        ({"rate": "fast"}, "a number or null"),
        ({"kind": "c"}, "one of 'a', 'b'"),
    ],
)
def test_a_value_of_another_kind_or_out_of_bounds_is_refused(given, expected):
    with pytest.raises(UsageError, match=f"of x is .*expected {expected}"):
        resolve_parameters("x", Known, given)
