"""The examples run, and show what they say."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra sim")
EXAMPLE = Path(__file__).parents[1] / "examples" / "live_alarm.py"


@pytest.fixture(scope="module")
def example():
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE), run_name="live_alarm"))


def test_a_live_loop_raises_an_alarm_after_the_onset_only(example, tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="needs the extra plots")
    plot = tmp_path / "alarm.png"
    options = ["--detector", "mewma", "--fit", str(tmp_path / "fit")]
    nominal, anomalous = example.main([*options, "--plot", str(plot)])
    assert nominal.alarms == []
    assert min(anomalous.alarms) > 150
    assert "steps after the onset" in capsys.readouterr().out
    assert plot.read_bytes().startswith(b"\x89PNG")
    # The kept fit gives the same scores as the first one.
    assert np.array_equal(example.main(options)[1].scores, anomalous.scores, equal_nan=True)
