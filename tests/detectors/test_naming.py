"""The namer of parts on episodes whose faults are known."""

import numpy as np
import pytest
from oodd_common.naming import WINDOW, PartNamer, ReadingModel

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError

D, A, ONSET = 8, 3, 60
UNITS = np.array([1.0, 10.0, 0.1, 1.0, 5.0, 1.0, 1.0, 0.5])
LEVELS = np.array([0.0, 20.0, -1.0, 0.5, 3.0, 0.0, -2.0, 1.0])

_rng = np.random.default_rng(1)
_MIXING = _rng.normal(size=(D, D))
DYNAMICS = 0.9 * _MIXING / np.abs(np.linalg.eigvals(_MIXING)).max()
INPUT = _rng.normal(size=(A, D))


def states(seed, rows=100, gains=None, push=0.0):
    """Return states, (rows, D), and commands of a vector autoregression.

    `gains` multiply the commands, and `push` the noise, from row `ONSET` on.
    """
    rng = np.random.default_rng(seed)
    commands, state = rng.normal(size=(rows - 1, A)), np.zeros((rows, D))
    for t in range(1, rows):
        late = t >= ONSET
        acts = commands[t - 1] * (gains if late and gains is not None else np.ones(A))
        noise = 0.2 * (1 + push * late) * rng.normal(size=D)
        state[t] = state[t - 1] @ DYNAMICS + acts @ INPUT + noise
    return state, commands


def episode(seed, *, fault=None, actions=True, **changes):
    """Return an episode in units of sensors; `fault` changes the readings from `ONSET` on."""
    state, commands = states(seed, **changes)
    readings = LEVELS + UNITS * state
    if fault:
        readings[ONSET:] = fault(readings[ONSET:], np.random.default_rng(seed + 1000))
    return Trajectory(readings, commands if actions else None)


def offset(sensors, size):
    """Return a fault that adds so many states' units to sensors."""
    return lambda rows, _: rows + np.isin(np.arange(D), sensors) * size * UNITS


def noise(sensors, size):
    return lambda rows, rng: (
        rows + np.isin(np.arange(D), sensors) * size * UNITS * rng.normal(size=rows.shape)
    )


def named(naming):
    return np.flatnonzero(naming.sensors >= 0.5).tolist()


@pytest.fixture(scope="module")
def namer():
    return PartNamer.fit([episode(seed) for seed in range(12)])


@pytest.fixture(scope="module")
def blind():
    return PartNamer.fit([episode(seed, actions=False) for seed in range(12)])


@pytest.mark.parametrize("sensor", range(D))
def test_a_sensor_with_an_offset_is_named_and_its_neighbours_are_not(namer, sensor):
    for seed in range(100, 105):
        x = episode(seed, fault=offset([sensor], 3.0))
        naming, onset = namer.name(x[: ONSET + 4])
        assert named(naming) == [sensor]
        assert naming.kind == "sensor"
        assert abs(onset - ONSET) <= 1
        assert naming.sizes[sensor] == pytest.approx(3.0 * UNITS[sensor], rel=0.3)
        assert np.isnan(np.delete(naming.sizes, sensor)).all()


@pytest.mark.parametrize("fault", [offset, noise], ids=lambda f: f.__name__)
def test_all_of_several_faulty_sensors_are_named(namer, fault):
    faulty, hits, count = [1, 4, 6], 0, 0
    for seed in range(100, 110):
        naming, _ = namer.name(episode(seed, fault=fault(faulty, 3.0))[: ONSET + 6])
        hits += len({*named(naming)} & {*faulty})
        count += len(named(naming))
    assert hits >= 0.9 * 30
    assert hits >= 0.9 * count


def test_without_actions_sensors_are_named_too(blind):
    naming, _ = blind.name(episode(100, actions=False, fault=offset([2], 12.0))[: ONSET + 4])
    assert named(naming) == [2]
    assert naming.actuators.shape == (0,)


@pytest.mark.parametrize("actuator", range(A))
def test_a_dead_actuator_is_named_and_no_sensor(namer, actuator):
    gains, right = np.ones(A), 0
    gains[actuator] = 0.0
    for seed in range(100, 110):
        naming, _ = namer.name(episode(seed, gains=gains)[: ONSET + WINDOW])
        right += naming.kind == "actuator" and naming.actuators.argmax() == actuator
        assert naming.kind != "actuator" or not named(naming)
    assert right >= 8


def test_larger_noise_of_the_whole_process_names_no_sensor(namer):
    quiet = 0
    for seed in range(100, 120):
        naming, _ = namer.name(episode(seed, push=3.0)[: ONSET + 6])
        quiet += not named(naming) and naming.kind in ("body", "environment")
    assert quiet >= 17


def test_nominal_rows_name_nothing(namer):
    episodes = [episode(seed) for seed in range(200, 220)]
    namings = [namer.name(x[:t])[0] for x in episodes for t in (10, 37, 80, 100)]
    assert np.mean([not named(n) and not (n.actuators >= 0.5).any() for n in namings]) >= 0.9


def test_sensors_that_fall_silent_are_named_at_once_and_alone(namer):
    silent = lambda rows, _: rows * ~np.isin(np.arange(D), [1, 5])  # noqa: E731
    for rows in (1, 2, 10):
        naming, onset = namer.name(episode(100, fault=silent)[: ONSET + rows])
        assert named(naming) == [1, 5]
        assert np.isinf(naming.sizes[[1, 5]]).all()
        assert onset == ONSET


def test_a_sensor_that_repeats_its_reading_is_named(namer):
    def stuck(rows, _):
        rows[:, 3] = rows[0, 3]
        return rows

    naming, onset = namer.name(episode(100, fault=stuck)[: ONSET + 5])
    assert named(naming) == [3]
    assert onset == ONSET + 1


def test_a_naming_sees_no_later_row(namer):
    x = episode(100, fault=offset([1], 3.0))
    y = Trajectory(
        np.concatenate([x.observations[: ONSET + 3], 9 * x.observations[ONSET + 3 :]]),
        np.concatenate([x.actions[: ONSET + 2], -x.actions[ONSET + 2 :]]),
    )
    for (a, i), (b, j) in zip(_all_rows(namer, x), _all_rows(namer, y), strict=True):
        np.testing.assert_array_equal(a.sensors, b.sensors)
        assert (a.kind, i) == (b.kind, j)


def _all_rows(namer, x):
    live = namer.begin()
    for t, row in enumerate(x.observations[: ONSET + 3]):
        live.update(row, x.actions[t - 1] if t else None)
        yield live.name()


def test_live_and_recorded_namings_are_the_same_and_those_of_a_restored_fit(namer):
    restored = PartNamer.of({name: array.copy() for name, array in namer.arrays().items()})
    x = episode(100, fault=offset([1, 2], 3.0))
    for t, (live, onset) in enumerate(_all_rows(restored, x)):
        naming, recorded_onset = namer.name(x[: t + 1])
        assert (live.kind, onset) == (naming.kind, recorded_onset)
        for a, b in zip(live[:3], naming[:3], strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", ["naming_coefficients", "naming_covariance", "naming_price"])
def test_a_fit_of_other_arrays_is_refused(namer, name):
    arrays = namer.arrays()
    with pytest.raises(FittedStateError):
        PartNamer.of({key: a for key, a in arrays.items() if key != name})
    with pytest.raises(FittedStateError):
        PartNamer.of({**arrays, name: arrays[name][:-1]})


def test_the_onset_is_no_earlier_than_told(namer):
    x = episode(100, fault=offset([1], 3.0))
    assert namer.name(x[: ONSET + 9], since=ONSET + 4)[1] >= ONSET + 4


def test_constant_and_coarse_sensors_are_never_named():
    def coarse(seed, change=0.0):
        x = episode(seed)
        rows = x.observations.copy()
        rows[:, 0], rows[:, 1] = 7.0, np.sign(rows[:, 1] - LEVELS[1])
        rows[ONSET:, :2] += change
        return Trajectory(rows, x.actions)

    namer = PartNamer.fit([coarse(seed) for seed in range(12)])
    naming, _ = namer.name(coarse(100, change=50.0)[: ONSET + 4])
    assert (naming.sensors[:2] < 0.5).all()


def test_choices_of_a_discrete_action_are_no_actuators():
    def discrete(seed, rows=100):
        rng = np.random.default_rng(seed)
        actions, state = np.eye(2)[rng.integers(0, 2, rows - 1)], np.zeros((rows, 2))
        for t in range(1, rows):
            state[t] = 0.8 * state[t - 1] + actions[t - 1, 0] + 0.1 * rng.normal(size=2)
        return Trajectory(state, actions)

    namer = PartNamer.fit([discrete(seed) for seed in range(5)])
    assert (namer.name(discrete(9))[0].actuators < 0.5).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("actions", [0, 1, 4])
@pytest.mark.parametrize("sensors", [1, 2, 60])
@pytest.mark.parametrize("constant", [False, True])
def test_little_data_is_enough(sensors, actions, constant):
    rng = np.random.default_rng(0)

    def short(rows):
        o = np.full((rows, sensors), 3.0) if constant else rng.normal(size=(rows, sensors))
        return Trajectory(o, rng.normal(size=(rows - 1, actions)))

    namer = PartNamer.fit([short(10), short(7), short(2)])
    naming, onset = namer.name(short(10))
    assert naming.sensors.shape == naming.sizes.shape == (sensors,)
    assert naming.actuators.shape == (actions,)
    assert len(named(naming)) <= max(1, 0.4 * sensors)
    assert 0 <= onset < 10
    assert namer.name(short(1))[0].kind == ""


@pytest.mark.filterwarnings("error")
def test_huge_readings_and_far_levels_are_no_error(namer):
    wild = lambda rows, _: np.where(np.arange(D) == 2, 1e30, rows)  # noqa: E731
    assert named(namer.name(episode(100, fault=wild)[: ONSET + 4])[0]) == [2]
    far = [Trajectory(episode(seed).observations + 1e4, episode(seed).actions) for seed in range(9)]
    assert PartNamer.fit(far).name(far[0])[1] < 100


def test_a_fit_is_deterministic_and_its_model_is_that_of_readings(namer):
    again = PartNamer.fit([episode(seed) for seed in range(12)])
    for name, array in namer.arrays().items():
        np.testing.assert_array_equal(array, again.arrays()[name])
    model = ReadingModel.with_errors([episode(seed) for seed in range(12)])[0]
    np.testing.assert_array_equal(model.coefficients, namer.model.coefficients)
    fed_back = ReadingModel.fit([episode(seed) for seed in range(12)])
    assert (np.abs(fed_back.coefficients) ** 2).sum() < (np.abs(model.coefficients) ** 2).sum()
    forecast = model.coefficients[: 2 * D].reshape(2, D, D)[0]
    states_per_unit = UNITS / model.sensors.std
    expected = DYNAMICS * states_per_unit / states_per_unit[:, None]
    np.testing.assert_allclose(forecast, expected, atol=0.15)
