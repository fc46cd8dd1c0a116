"""Discovery: what is broken harms nobody else, and is named."""

import re
import subprocess
import sys

import pytest
from helpers_plugins import install

from oodd_eval.errors import MissingExtraError, UnknownNameError, UsageError
from oodd_eval.plugins.baselines import Clock
from oodd_eval.plugins.contract import DetectorSpec
from oodd_eval.plugins.discovery import Offer, discover, resolve_parameters

OFFER = """
@hookimpl
def oodd_detectors():
    return offer({name}=Good)
"""


def test_built_in_detectors_are_offered():
    assert {"random", "persistence", "clock"} <= set(discover().offers)


def test_an_installed_plugin_is_found_with_its_origin(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "extra", OFFER.format(name="extra"), version="2.5")
    offer = discover().offer("extra")
    assert (offer.origin, offer.plugin, offer.module) == ("oodd-extra 2.5", "extra", "oodd_extra")


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("raise RuntimeError('not today')", "RuntimeError: not today"),
        ("import sys; sys.exit(3)", "SystemExit: 3"),
        ("class Odd(BaseException): pass\nraise Odd('on purpose')", "Odd: on purpose"),
        (
            "class Mute(Exception):\n    def __str__(self): raise ValueError\nraise Mute",
            r"Mute: \(its text cannot be had\)",
        ),
        ("def f(:", "SyntaxError"),
        ("@hookimpl\ndef oodd_detectors(): return [1]", r"returned \[1\], expected a list of oodd"),
        ("@hookimpl\ndef oodd_detectors(): return 1 / 0", "ZeroDivisionError"),
        ("@hookimpl\ndef oodd_detector(): return []", "unknown hook 'oodd_detector'"),
        ("@hookimpl\ndef oodd_run_started(nothing): pass", "nothing"),
    ],
)
def test_a_broken_plugin_is_named_and_the_others_work(monkeypatch, tmp_path, code, reason):
    install(monkeypatch, tmp_path / "a", "aaa", code)
    install(monkeypatch, tmp_path / "b", "zzz", OFFER.format(name="zzz"))
    plugins = discover()
    (broken,) = [b for b in plugins.broken if b.plugin == "aaa"]
    assert broken.distribution == "oodd-aaa"
    assert re.search(reason, broken.reason)
    assert {"zzz", "clock"} <= set(plugins.offers)
    assert not plugins.manager.has_plugin("aaa")


def test_nothing_of_a_failed_plugin_stays(monkeypatch, tmp_path):
    code = "@hookimpl\ndef oodd_detectors(): return [*offer(fine=Good), *offer(clock=Good)]"
    install(monkeypatch, tmp_path, "half", code)
    plugins = discover()
    assert "fine" not in plugins.offers
    assert plugins.offer("clock").distribution == "oodd-eval"
    assert not plugins.manager.has_plugin("half")


def test_a_detector_offered_twice_names_both_distributions(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "a", "one", OFFER.format(name="same"))
    install(monkeypatch, tmp_path / "b", "two", OFFER.format(name="same"))
    (broken,) = discover().broken
    assert "'same' is offered twice, by oodd-one (plug-in 'one') and by oodd-two" in broken.reason


def test_no_other_distribution_takes_a_built_in_name(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "aardvark", OFFER.format(name="clock"))
    plugins = discover()
    assert plugins.offer("clock").spec.factory is Clock
    assert [b.plugin for b in plugins.broken] == ["aardvark"]


def test_two_plugins_of_one_name_are_an_error_naming_the_other(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "trivial", OFFER.format(name="mine"))
    (broken,) = discover().broken
    assert (broken.distribution, broken.reason) == (
        "oodd-trivial",
        "oodd-eval has a plug-in of the same name: uninstall one of them",
    )


def test_the_environment_variable_restricts(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "extra", OFFER.format(name="extra"))
    monkeypatch.setenv("OODD_EVAL_PLUGINS", "extra")
    assert set(discover().offers) == {"extra", "random", "persistence", "clock"}


def test_a_disabled_plugin_is_left_out():
    assert "clock" not in discover(["trivial"]).offers


@pytest.mark.parametrize("arguments", [{"disabled": ["nosuch"]}, {"only": ["nosuch"]}])
def test_restricting_to_what_is_not_installed_is_an_error(arguments):
    with pytest.raises(UnknownNameError, match="unknown plug-in 'nosuch'"):
        discover(**arguments)


def test_unknown_detector_suggests_the_nearest():
    with pytest.raises(UnknownNameError, match="did you mean 'persistence'"):
        discover().offer("persistance")


def spec_requiring(*modules, extra=""):
    spec = DetectorSpec("x", Clock, "", requires=modules, extra=extra)
    return Offer(spec, "x", "oodd_x", "oodd-x", "1.0")


def test_what_can_be_imported_is_available():
    assert spec_requiring("numpy", "os.path").unavailable() == ""


def test_what_is_missing_is_named_with_the_command_that_helps():
    offer = spec_requiring("numpy", "no_such", extra="oodd-eval[reference]")
    assert offer.unavailable() == 'needs no_such: pip install "oodd-eval[reference]"'
    with pytest.raises(MissingExtraError, match="detector 'x' needs no_such"):
        offer.require()


def test_a_missing_parent_package_is_missing_too():
    assert (
        "needs no_such.part: pip install no_such.part"
        in spec_requiring("no_such.part").unavailable()
    )


def test_parameters_are_defaults_and_overrides():
    spec = DetectorSpec("x", Clock, "", parameters={"b": 1, "a": None})
    assert resolve_parameters(spec, {"b": 2.5}) == {"a": None, "b": 2.5}


def test_an_unknown_parameter_suggests_the_nearest():
    spec = DetectorSpec("x", Clock, "", parameters={"members": 5})
    with pytest.raises(UnknownNameError, match="parameter of x 'member': did you mean 'members'"):
        resolve_parameters(spec, {"member": 1})


@pytest.mark.parametrize("value", ["five", True, None])
def test_a_parameter_of_another_kind_is_refused(value):
    spec = DetectorSpec("x", Clock, "", parameters={"members": 5})
    with pytest.raises(UsageError, match="expected a number like its default 5"):
        resolve_parameters(spec, {"members": value})


@pytest.mark.parametrize("what", ["detectors", "envs", "metrics"])
def test_listing_imports_nothing_heavy(what):
    code = (
        "import sys\nfrom oodd_eval.cli.main import main\n"
        f"main(['list', {what!r}])\n"
        "sys.exit(repr({'torch', 'sklearn', 'h5py', 'gymnasium', 'pybullet'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == "set()"


def test_help_imports_not_even_numpy():
    code = (
        "import sys\nfrom oodd_eval.cli.main import main\n"
        "main(['--help'])\nsys.exit('numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == 0
