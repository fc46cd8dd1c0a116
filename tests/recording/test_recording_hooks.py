"""Hooks of recording with known answers: roles, noise, memory, units, schedules, digests."""

import subprocess
import sys
from importlib.metadata import version
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra gym")
import gymnasium
from helpers_own import CISTERN, forget_own
from helpers_plugins import install
from oodd_recording.checks import Blinking
from oodd_recording.closed_loop import Setup, measure, record_anomalous, record_attempt
from oodd_recording.environments import make
from oodd_recording.faults import Scheduled, SensorFault, make_fault
from oodd_recording.policies import CustomPolicy, load_policy, scaled
from oodd_recording.registered import code_digest, info_of
from oodd_recording.values import choose_sensors, spread_of

from oodd_eval import AnomalySpec, EnvironmentSpec, Fault, Quantity, load_split
from oodd_eval.cli.main import main
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.offers import check_spec, with_intermittent
from oodd_eval.data.registry import register
from oodd_eval.errors import MissingExtraError, PluginError, SimulationError, UsageError

SEED = 77
SIZES = ["--train", "4", "--calibration", "4", "--test", "3", "--seed-base", "77", "--jobs", "1"]


@pytest.fixture
def cistern(monkeypatch, tmp_path):
    """The plug-in's module, registered here, and installed for commands."""
    install(monkeypatch, tmp_path / "plugin", "cistern", CISTERN, header="")
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "splits"))
    module = __import__("oodd_cistern")
    register(with_intermittent([*module.oodd_environments(), *module.oodd_anomalies()]))
    yield module
    forget_own()


def setup():
    return Setup("cistern", load_policy("cistern"))


def build(name, *options):
    return main(["data", "build", name, *SIZES, "--env", "cistern", *options])


# Roles and noise


def test_recorded_rows_have_the_noise_of_the_table_and_references_have_none(cistern):
    """Measured minus true: the simulator's own rows for the same actions."""
    noise = []
    for seed in range(8):
        twin = setup().record(seed)
        simulator = make("cistern")
        rows = [simulator.reset(seed), *(simulator.step(a)[0] for a in twin.trajectory.actions)]
        noise.append(twin.trajectory.observations.astype(np.float64) - np.array(rows))
    noise = np.concatenate(noise)
    # Of 968 draws: a standard deviation is 2.3 % off, four times that is rare.
    np.testing.assert_allclose(noise.std(axis=0)[:2], [0.01, 0.002], rtol=0.1)
    np.testing.assert_allclose(noise.mean(axis=0)[:2], 0, atol=4 * 0.01 / np.sqrt(len(noise)))
    assert not noise[:, 2].any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"role": "guessed"}, "expected one of measured, reference, memory"),
        ({"noise": -0.1}, "noise -0.1"),
        ({"noise": float("inf")}, "noise inf"),
        ({"role": "memory", "noise": 0.1}, "is not measured"),
    ],
)
def test_a_column_without_sense_is_refused(options, message):
    with pytest.raises(UsageError, match=message):
        Quantity("level", "m", **options)


def test_noise_in_shares_of_the_spread_adds_to_the_table_in_squares(cistern):
    policy = load_policy("cistern")
    measure("cistern", policy)
    noisy = Setup("cistern", policy, noise=0.5)
    twin = noisy.record(SEED)
    simulator = make("cistern")
    rows = [simulator.reset(SEED), *(simulator.step(a)[0] for a in twin.trajectory.actions)]
    noise = twin.trajectory.observations.astype(np.float64) - np.array(rows)
    expected = np.sqrt(0.01**2 + (0.5 * spread_of("cistern")[0]) ** 2)
    assert noise[:, 0].std() == pytest.approx(expected, rel=0.25)  # of 121 draws
    assert not noise[:, 2].any()
    # Faults of the benchmark corrupt measured columns alone.
    chosen = {int(choose_sensors("cistern", np.random.default_rng(i))[0]) for i in range(50)}
    assert chosen == {0, 1}


def test_a_fault_of_a_column_that_no_sensor_measures_is_refused_by_name(cistern):
    spec = AnomalySpec("askew", "sensor", "goal", "m", 1.0, askew, ("cistern",))
    register([spec])
    with pytest.raises(SimulationError, match=r"askew corrupts goal \(reference\) in cistern"):
        record_anomalous(setup(), "askew", 0.5, setup().record(SEED))


def askew(strength, rng, simulator):
    return SensorFault(np.array([0, 2]), lambda x, _: x + strength)


# Controllers with memory


class Counting:
    """A controller whose action is the number of rows since reset(), which `forgets` or not."""

    forgets = True

    def __init__(self):
        self.count, self.rows = 0, []

    def reset(self):
        self.count = self.count if self.rows and not self.forgets else 0
        self.rows.append([])

    def act(self, row):
        self.count += 1
        self.rows[-1].append(row)
        return [min(8.0, self.count / 64)]


def test_a_controller_with_memory_sees_every_row_and_repeats_its_twin(cistern):
    policy = CustomPolicy("cistern", Counting())
    nominal = Setup("cistern", policy)
    twin = nominal.record(SEED)
    episode = record_anomalous(nominal, "surge", 0.4, twin)
    first, second = policy._act.__self__.rows
    np.testing.assert_array_equal(first, twin.trajectory.observations[:-1])
    np.testing.assert_array_equal(second, episode.trajectory.observations[:-1])
    onset = episode.onset
    for recorded in ("observations", "actions"):
        one, other = (getattr(e.trajectory, recorded) for e in (episode, twin))
        assert one[: onset - 1].tobytes() == other[: onset - 1].tobytes()
    # One more row, one more 64th: also where the anomaly begins.
    steps = np.arange(1, len(episode.trajectory.actions) + 1) / 64
    np.testing.assert_array_equal(episode.trajectory.actions[:, 0], np.minimum(steps, 8))


def test_a_controller_that_does_not_forget_is_an_error_that_says_what_to_do(cistern, monkeypatch):
    monkeypatch.setattr(Counting, "forgets", False)
    nominal = Setup("cistern", CustomPolicy("cistern", Counting()))
    twin = nominal.record(SEED)
    with pytest.raises(SimulationError, match=r"let reset\(\) forget all that act\(\) remembers"):
        record_anomalous(nominal, "surge", 0.4, twin)


class Reusing:
    """It writes into its argument, and returns the same array again and again."""

    def __init__(self):
        self.volts = np.zeros(1, np.float32)

    def __call__(self, row):
        row -= 1.0
        self.volts[0] = 3.0 - 4.0 * row[0]
        return self.volts


def test_controllers_may_reuse_their_arrays(cistern):
    twin = Setup("cistern", CustomPolicy("cistern", Reusing())).record(SEED)
    rows, actions = twin.trajectory.observations, twin.trajectory.actions
    np.testing.assert_array_equal(actions[:, 0], 3 - 4 * (rows[:-1, 0] - np.float32(1)))
    assert len(np.unique(actions)) > 50


# Actions in physical units


def drawn(kind, strength):
    simulator = make("cistern")
    simulator.reset(SEED)
    return make_fault(kind, strength, simulator, np.random.default_rng(1)), simulator


def test_strengths_of_commands_are_shares_of_half_the_range_and_stay_within(cistern):
    def volts(value):
        return np.array([value], np.float32)

    fault, simulator = drawn("bias", 0.25)
    sign = fault.parameters["direction"]
    assert fault.command(volts(3.0), simulator) == 3.0 + sign * 0.25 * 4
    assert fault.command(volts(0.5 if sign < 0 else 7.5), simulator) == (0 if sign < 0 else 8)
    fault, simulator = drawn("action-noise", 0.1)
    commands = np.array([fault.command(volts(4.0), simulator)[0] for _ in range(4000)])
    assert commands.std() == pytest.approx(0.1 * 4, rel=0.05)
    assert commands.mean() == pytest.approx(4.0, abs=0.03)
    at_the_end = np.array([fault.command(volts(8.0), simulator)[0] for _ in range(400)])
    assert at_the_end.max() == 8.0
    simulator.wind = -0.25
    assert simulator.command(volts(3.0)) == 2.0
    assert simulator.command(volts(0.5)) == 0.0


def test_trained_policies_command_in_the_units_of_the_environment(cistern):
    info, actions = info_of("cistern"), np.array([[-1.0], [-0.5], [0.0], [1.0]], np.float32)
    assert info.limits == ((0.0,), (8.0,))  # of the box
    assert ENVIRONMENTS["hopper"].limits == ((-1.0,) * 3, (1.0,) * 3)
    np.testing.assert_array_equal(scaled(actions, info)[:, 0], [0, 2, 4, 8])
    zero = np.array([-0.0], np.float32)
    assert np.signbit(scaled(zero, ENVIRONMENTS["hopper"]))[0]  # not even a sign changes


def make_rescaled():
    from oodd_cistern import Cistern

    return gymnasium.wrappers.RescaleAction(Cistern(), np.float32(-1), np.float32(1))


class Rescaled:
    """The same controller for actions from -1 to 1."""

    def __init__(self):
        from oodd_cistern import Integral

        self.inner = Integral()

    def reset(self):
        self.inner.reset()

    def act(self, row):
        return [self.inner.act(row)[0] / 4 - 1]


def test_physical_and_rescaled_actions_give_the_same_episodes(cistern):
    def episodes():
        nominal = setup()
        twin = nominal.record(SEED)
        kinds = {"bias": 0.25, "wind-l2r": 0.125, "gain": 0.0}
        attempts = [record_anomalous(nominal, k, s, twin, redraws=0) for k, s in kinds.items()]
        return [twin, *attempts]

    physical = episodes()
    (spec,) = cistern.oodd_environments()
    register([EnvironmentSpec(spec.name, make_rescaled, Rescaled, spec.sensors, spec.actions, 120)])
    rescaled = episodes()
    assert info_of("cistern").limits == ((-1.0,), (1.0,))
    for one, other in zip(physical, rescaled, strict=True):
        assert one.trajectory.observations.tobytes() == other.trajectory.observations.tobytes()
        np.testing.assert_array_equal(one.trajectory.actions, 4 * (other.trajectory.actions + 1))


# Faults that grow, end and rest


class Noted(Fault):
    """A fault of one sensor that notes its shares, and every begin and end by its row."""

    def __init__(self):
        super().__init__({"sensors": [0]})
        self.shares, self.begins, self.ends, self.draws = [], [], [], 0

    def begin(self, simulator, rows):
        self.begins.append(len(self.shares))

    def command(self, action, simulator):
        self.shares.append(self.share)
        return action + 1

    def observe(self, row, step):
        self.draws += 1
        return row + np.float32(8)

    def end(self, simulator):
        self.ends.append(len(self.shares) - 1)


def nothing(strength, rng, simulator):
    return Fault({})


@pytest.mark.parametrize(
    ("rows", "schedule", "shares", "begins", "ends"),
    [
        (24, {"ramp": 16}, [min(1, (k + 1) / 16) for k in range(24)], [0], []),
        (24, {"lasts": 5}, [1] * 5 + [0] * 19, [0], [5]),
        (12, {"pulses": (2, 3)}, [1, 1, 0, 0, 0] * 2 + [1, 1], [0, 5, 10], [2, 7]),
        (10, {"ramp": 8, "lasts": 4}, [1 / 8, 2 / 8, 3 / 8, 4 / 8] + [0] * 6, [0], [4]),
    ],
)
def test_faults_grow_end_and_come_back_by_their_rows(rows, schedule, shares, begins, ends):
    spec = AnomalySpec("noted", "sensor", "one", "1", 1.0, nothing, **schedule)
    inner = Noted()
    fault = Scheduled(inner, spec)
    simulator = SimpleNamespace(restore=lambda: None)
    fault.begin(simulator, [])
    commands, observed = [], []
    for step in range(rows):
        commands.append(fault.command(0, simulator))
        observed.append(float(fault.observe(np.zeros(1, np.float32), step)[0]))
    assert inner.draws == rows
    assert observed == [8.0 * share for share in shares]
    assert commands == [int(share > 0) for share in shares]
    assert [s for s, on in zip(inner.shares, shares, strict=True) if on] == [s for s in shares if s]
    assert (inner.begins, inner.ends) == (begins, ends)


def setup_without_noise(cistern):
    (spec,) = cistern.oodd_environments()
    exact = tuple(Quantity(q.name, q.unit, q.role) for q in spec.sensors)
    register([EnvironmentSpec("cistern", spec.make, spec.policy, exact, spec.actions, 120)])
    return setup()


def test_dynamics_are_nominal_after_a_surge(cistern):
    """The inflow of each row, from its levels and volts; noise off, to see it."""
    nominal = setup_without_noise(cistern)
    episode = record_anomalous(nominal, "surge", 0.25, nominal.record(SEED))
    level = episode.trajectory.observations[:, 0].astype(np.float64)
    pumped = 0.1 * episode.trajectory.actions[:, 0].astype(np.float64)
    inflow = np.diff(level) / 0.2 - pumped + 0.3 * level[:-1]
    expected = np.zeros(len(inflow))
    expected[episode.onset - 1 : episode.onset + 14] = 0.25
    np.testing.assert_allclose(inflow, expected, atol=1e-5)


def test_a_ramp_wears_a_pump_row_by_row(cistern):
    nominal = setup_without_noise(cistern)
    episode = record_anomalous(nominal, "clog", 0.5, nominal.record(SEED))
    gain = episode.trajectory.observations[1:, 1] / episode.trajectory.actions[:, 0]
    rows = np.arange(1, len(gain) + 1) - episode.onset + 1  # from 1 at the onset
    np.testing.assert_allclose(gain, 0.1 * (1 - 0.5 * np.clip(rows / 20, 0, 1)), rtol=1e-5)


def test_intermittent_kinds_of_ones_own_are_listed_and_recorded(cistern, capsys):
    assert main(["list", "anomalies"]) == 0
    assert "offset-intermittent" in capsys.readouterr().out
    assert build("mine", "--strength", "offset-intermittent=0.5") == 0
    split = load_split("mine")
    data = split.environment("cistern")
    assert data.sensors == cistern.SENSORS  # roles and noise are stored
    versions = split.manifest["versions"]
    assert set(versions) == {"oodd-eval", "numpy", "gymnasium", "click", "python"}
    assert versions["click"] == version("click")
    part = data.anomalous("offset-intermittent")
    # The sensor lies inside the loop: between pulses rows are those of the simulator, again.
    episode, onset = part[0], part.onsets[0]
    simulator, measured = make("cistern"), episode.observations[:, 0]
    rows = [simulator.reset(int(part.seeds[0])), *(simulator.step(a)[0] for a in episode.actions)]
    error = measured - np.array(rows)[:, 0]
    age = np.arange(len(error)) - onset
    on = (age >= 0) & (age % 50 < 10)
    assert on.sum() >= 10
    np.testing.assert_allclose(error[on], 0.5, atol=0.06)
    np.testing.assert_allclose(error[~on], 0.0, atol=0.06)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ramp": -1}, "ramp -1"),
        ({"lasts": -2}, "lasts -2"),
        ({"pulses": (0, 4)}, "two numbers of rows from 1"),
        ({"pulses": (4,)}, "two numbers of rows from 1"),
        ({"pulses": (4, 4), "intermittent": True}, "expected intermittent=False"),
    ],
)
def test_rows_of_a_fault_that_make_no_sense_are_refused(options, message):
    with pytest.raises(PluginError, match=message):
        check_spec(AnomalySpec("wear", "dynamics", "one", "1", 1.0, nothing, **options))
    with pytest.raises(PluginError, match="task 'cost', expected one of return, loss"):
        check_spec(EnvironmentSpec("one", make_rescaled, Rescaled, (), (), 99, task="cost"))


# What a split says of the plug-in


@pytest.fixture
def package(monkeypatch, tmp_path):
    """A plug-in that is a package with a helper and a data file, registered."""
    home = tmp_path / "oodd_packed"
    home.mkdir()
    (home / "__init__.py").write_text("def make():\n    from oodd_packed import helper\n")
    (home / "helper.py").write_text("GAIN = 1\n")
    (home / "model").mkdir()
    (home / "model" / "arm.xml").write_text("<mujoco/>\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "oodd_packed", raising=False)
    module = __import__("oodd_packed")
    ladder = home / "ladder.json"
    register([EnvironmentSpec("packed", module.make, module.make, (), (), 99, ladder=ladder)])
    yield home
    sys.modules.pop("oodd_packed", None)
    forget_own()


def test_the_digest_is_of_the_whole_package_but_for_caches_and_ladders(package):
    digests = [code_digest("packed", [])]
    (package / "__pycache__").mkdir(exist_ok=True)  # importing may have written it
    for name in ("__pycache__/helper.pyc", ".helper.py.swp", "ladder.json", "ladder.json.work"):
        (package / name).write_text("x")
    assert code_digest("packed", []) == digests[0]
    for name, text in (("helper.py", "GAIN = 2\n"), ("model/arm.xml", "<mujoco model='2'/>\n"),
                       ("model/leg.xml", "<mujoco/>\n")):  # fmt: skip
        (package / name).write_text(text)
        digests.append(code_digest("packed", []))
    assert len(set(digests)) == 4


def test_the_digest_leaves_out_what_the_first_calibration_measures(package):
    module = sys.modules["oodd_packed"]
    register([EnvironmentSpec("packed", module.make, module.make, (), (), 99)])  # no ladder yet
    before = code_digest("packed", [])
    (package / "ladder.json.work").write_text("x")
    assert code_digest("packed", []) == before


def test_the_digest_does_not_depend_on_where_a_package_lies(package, monkeypatch):
    before = code_digest("packed", [])
    elsewhere = package.parent / "z" / "y"
    elsewhere.mkdir(parents=True)
    package.rename(elsewhere / package.name)
    monkeypatch.syspath_prepend(str(elsewhere))
    monkeypatch.delitem(sys.modules, "oodd_packed")
    module = __import__("oodd_packed")
    register([EnvironmentSpec("packed", module.make, module.make, (), (), 99)])
    assert code_digest("packed", []) == before


def test_a_package_that_is_not_installed_is_named_and_a_later_call_needs_none(
    cistern, monkeypatch, tmp_path, capsys
):
    sizes = [*SIZES, "--cap", "80"]
    assert main(["data", "build", "two", *sizes, "--env", "cistern", "--strength", "iid=0.3"]) == 0
    code = CISTERN.replace('packages=("click",)', 'packages=("no-such-simulator",)')
    install(monkeypatch, tmp_path / "other", "cistern", code, header="")
    assert build("mine", "--strength", "offset=0.3") == 4
    assert "no-such-simulator is not installed" in capsys.readouterr().err
    assert main(["data", "build", "two", *sizes, "--env", "cartpole", "--strength", "iid=0.3"]) == 0
    split = load_split("two")
    assert split.environments == ("cartpole", "cistern")
    assert "click" in split.manifest["versions"]


# Simulators are imported where they record


@pytest.mark.parametrize(
    ("package", "environment"), [("oodd_recording.benchmark", "cartpole"), ("oodd_worlds", "tank")]
)
def test_recording_imports_no_other_simulator(package, environment):
    program = f"""
import sys
from oodd_eval.data.registry import register
from {package} import oodd_anomalies, oodd_environments
register([*oodd_environments(), *oodd_anomalies()])
from oodd_recording.policies import load_policy
from oodd_recording.closed_loop import Setup
Setup("{environment}", load_policy("{environment}"), 60).record(1)
others = {{"pybullet", "pybullet_envs_gymnasium", "Box2D", "mujoco"}} & set(sys.modules)
sys.exit(f"imported {{others}}" if others else 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_without_pybullet_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.delitem(sys.modules, "oodd_recording.bullet", raising=False)
    with pytest.raises(MissingExtraError, match=r"oodd-eval\[bullet\]"):
        make("hopper")


# Fault is public


def test_a_fault_is_public_and_needs_no_recorder():
    code = (
        "import sys\n"
        "from oodd_eval import Fault\n"
        "assert Fault({}).parameters == {}\n"
        "loaded = sorted({'numpy', 'oodd_recording', 'gymnasium'} & set(sys.modules))\n"
        "sys.exit(f'imported {loaded}' if loaded else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_fault_that_ends_before_every_transition_leaves_its_twin(cistern):
    """What the check `end` drives; here by hand, against a fault that does not put back."""
    nominal = setup()
    twin = nominal.record(SEED)

    def maker(strength, make_kind):
        return lambda simulator, rng: Blinking(make_kind(strength, rng, simulator))

    clean = record_attempt(nominal, "surge", twin, maker(0.4, cistern.surge))
    assert clean.trajectory.observations.tobytes() == twin.trajectory.observations.tobytes()
    worn = record_attempt(nominal, "clog", twin, maker(0.4, cistern.clog))
    assert worn.effect == worn.onset
