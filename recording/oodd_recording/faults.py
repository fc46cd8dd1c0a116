"""Anomalies with one scalar strength: the kinds of the suite ladder.

A kind's strength is 0 for nothing at all. Its unit and its largest sensible strength depend on the
environment, see `oodd_recording.values`. What a fault draws (sensors, actuator, noise)
depends on the generator and not on its strength: two strengths differ in nothing else.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.registry import AnomalySpec, Fault, anomaly_spec, environment_spec
from oodd_eval.errors import SimulationError
from oodd_recording.registered import info_of
from oodd_recording.simulator import Row, Simulator
from oodd_recording.values import VALUES, choose_sensors, spread_of

AR: Final = 0.9  # coefficient of the correlated noise

Command = Any
"""The number of a discrete action, or a float32 row of shape (A,)."""


class SensorFault(Fault):
    """A fault of some sensors.

    Parameters
    ----------
    sensors
        Numbers of their columns, of shape (k,).
    change
        Called as ``change(values, step)`` on every row from the onset on; gets the values of these
        sensors, float64 of shape (k,), and returns what they report.
    drawn
        What else was drawn, as plain JSON; stored with the episode.
    """

    def __init__(self, sensors: NDArray[np.intp], change: Callable[..., Any], **drawn: Any) -> None:
        super().__init__({"sensors": [int(s) for s in sensors], **drawn})
        self.sensors, self._change = sensors, change
        self._before: Sequence[Row] = ()

    def begin(self, simulator: Simulator, rows: Sequence[Row]) -> None:
        """Keep the rows until now: some faults repeat them.

        Parameters
        ----------
        simulator
            The episode's.
        rows
            Observation rows seen until then.
        """
        self._before = list(rows)

    def observe(self, row: Row, step: int) -> Row:
        """Return the row with the values of the chosen sensors changed.

        Parameters
        ----------
        row
            Row of the simulator, float32 of shape (D,).
        step
            Its number in the episode.

        Returns
        -------
        float32 array of shape (D,)
        """
        values = row[self.sensors].astype(np.float64)
        changed = row.copy()
        changed[self.sensors] = np.asarray(self._change(values, step), dtype=np.float32)
        return changed

    def history(self) -> NDArray[np.float64]:
        """Return what the chosen sensors measured before the onset.

        Returns
        -------
        float64 array of shape (rows, k)
        """
        return np.array([row[self.sensors] for row in self._before], dtype=np.float64)


class Scheduled(Fault):
    """Another fault, in force to the share that its kind says for each row from the onset on."""

    def __init__(self, fault: Fault, spec: AnomalySpec) -> None:
        super().__init__(fault.parameters)
        self._fault, self._spec, self._count = fault, spec, 0
        self._rows: Sequence[Row] = ()
        self._on = True
        fault.share = self._share()

    def _share(self) -> float:
        """Return the share in force for the transition onto the next row."""
        spec, count = self._spec, self._count
        on, off = spec.pulses or (1, 0)
        if (spec.lasts and count >= spec.lasts) or count % (on + off) >= on:
            return 0.0
        return min(1.0, (count + 1) / spec.ramp) if spec.ramp else 1.0

    def begin(self, simulator: Simulator, rows: Sequence[Row]) -> None:
        """Prepare the fault."""
        self._rows = rows
        self._fault.begin(simulator, rows)

    def command(self, action: Command, simulator: Simulator) -> Command:
        """Let the fault act on the command, or put the simulator back."""
        self._fault.share = share = self._share()
        if share and not self._on:
            self._fault.begin(simulator, self._rows)
        # A fault that rests is asked, too: its draws go on.
        changed = self._fault.command(action, simulator)
        if not share and self._on:
            self._fault.end(simulator)
        self._on = share > 0
        if self._on:
            return changed
        simulator.restore()
        return action

    def observe(self, row: Row, step: int) -> Row:
        """Let the fault act on the row by its share; draws go on while it rests."""
        changed, share = self._fault.observe(row, step), self._share()
        self._count += 1
        if share in {0.0, 1.0}:
            return changed if share else row
        mixed = row + share * (changed.astype(np.float64) - row)
        return np.asarray(mixed, dtype=np.float32)


class Dynamics(Fault):
    """A fault of the dynamics: `act` gets action and simulator and returns the command."""

    def __init__(self, act: Callable[[Command, Simulator], Command], **drawn: Any) -> None:
        super().__init__(drawn)
        self._act = act

    def command(self, action: Command, simulator: Simulator) -> Command:
        """Return what the fault makes of the action."""
        return self._act(action, simulator)


def make_fault(kind: str, strength: float, simulator: Simulator, rng: np.random.Generator) -> Fault:
    """Draw a fault of one kind for one episode.

    Parameters
    ----------
    kind
        Name of a registered kind of anomaly.
    strength
        From 0, which changes nothing, to the kind's bound.
    simulator
        The episode's simulator, from which nominal values are read.
    rng
        Generator of this episode's draws.

    Raises
    ------
    SimulationError
        When the fault corrupts a column that is not measured.
    """
    spec, columns = anomaly_spec(kind), environment_spec(simulator.environment).sensors
    fault: Fault = spec.make(float(strength), rng, simulator)
    fault.parameters["strength"] = float(strength)
    corrupted = [columns[i] for i in fault.parameters.get("sensors", ())]
    if others := [f"{q.name} ({q.role})" for q in corrupted if not q.measured]:
        raise SimulationError(
            f"{kind} corrupts {', '.join(others)} in {simulator.environment}, expected "
            "sensors that are measured: no sensor can break that does not exist"
        )
    return Scheduled(fault, spec) if spec.ramp or spec.lasts or spec.pulses else fault


_Maker = Callable[[str, float, Simulator, np.random.Generator], Fault]


def _noise(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    sensors = choose_sensors(environment, rng)
    std = strength * spread_of(environment)[sensors]
    return SensorFault(sensors, lambda x, _: x + std * rng.normal(size=len(x)))


def _calibration(environment: str, strength: float, _: Simulator, rng: Any) -> Fault:
    return SensorFault(choose_sensors(environment, rng), lambda x, _: x * (1 + strength))


def _drift(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    sensors = choose_sensors(environment, rng)
    slope = strength * spread_of(environment)[sensors]
    return SensorFault(sensors, lambda x, step: x + slope * step)


def _shutdown(environment: str, strength: float, _: Simulator, rng: Any) -> Fault:
    return SensorFault(choose_sensors(environment, rng), lambda x, _: x * (1 - strength))


def _ar1(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    """x_t = 0.9 x_{t-1} + e_t in each sensor, from its stationary distribution on."""
    sensors = choose_sensors(environment, rng)
    std, state = strength * spread_of(environment)[sensors], rng.normal(size=len(sensors))

    def change(x: NDArray[np.float64], _: int) -> NDArray[np.float64]:
        nonlocal state
        noisy = x + std * state
        state = AR * state + np.sqrt(1 - AR**2) * rng.normal(size=len(state))
        return noisy

    return SensorFault(sensors, change)


def _varma(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    """x_t = A x_{t-1} + e_t + 0.4 e_{t-1}, e_t correlated by .5, scaled to the variance of iid."""
    # A has 0.7 on its diagonal, and -0.2 from each sensor to the next.
    sensors = choose_sensors(environment, rng)
    k = len(sensors)
    a = 0.7 * np.eye(k) - (0.2 * np.eye(k, k=1) if k > 1 else 0)
    root = _on_a_grid(np.linalg.cholesky(0.5 * np.eye(k) + 0.5))
    # State (x, e): its stationary covariance solves S = F S F' + G G'.
    forward = np.block([[a, 0.4 * np.eye(k)], [np.zeros((k, 2 * k))]])
    driven = np.vstack([root, root])
    covariance = driven @ driven.T
    for __ in range(200):
        covariance = forward @ covariance @ forward.T + driven @ driven.T
    unit = _on_a_grid(1 / np.sqrt(np.diag(covariance)[:k]))
    scale = strength * spread_of(environment)[sensors] * unit
    start = _on_a_grid(np.linalg.cholesky(covariance + 1e-12 * np.eye(2 * k)))
    state = _product(start, rng.normal(size=2 * k))

    def change(x: NDArray[np.float64], _: int) -> NDArray[np.float64]:
        nonlocal state
        noisy = x + scale * state[:k]
        state = _product(forward, state) + _product(driven, rng.normal(size=k))
        return noisy

    return SensorFault(sensors, change)


def _on_a_grid(x: NDArray[Any]) -> NDArray[np.float64]:
    """Round to multiples of 2^-20: the last bits that LAPACK gives depend on the processor."""
    return np.asarray(np.round(x * 2**20) / 2**20)


def _product(matrix: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply without BLAS, which adds in an order that depends on the processor."""
    return np.asarray(np.add.reduce(matrix.T * vector[:, None]))  # one row after the other


def _delay(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    """Between two whole numbers of steps: the mean of both rows, weighted."""
    whole, part = int(strength), strength - int(strength)
    recent: deque[NDArray[np.float64]] = deque(maxlen=whole + 2)

    def change(x: NDArray[np.float64], _: int) -> NDArray[np.float64]:
        if not recent:
            recent.extend(fault.history())
        recent.append(x)
        newer, older = recent[max(-1 - whole, -len(recent))], recent[max(-2 - whole, -len(recent))]
        return (1 - part) * newer + part * older if part else newer

    fault = SensorFault(choose_sensors(environment, rng), change)
    return fault


def _stuck(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    def change(x: NDArray[np.float64], _: int) -> NDArray[np.float64]:
        return (1 - strength) * x + strength * fault.history()[-1] if strength else x

    fault = SensorFault(choose_sensors(environment, rng), change)
    return fault


def _wind(direction: int) -> _Maker:
    def maker(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
        discrete = info_of(environment).discrete

        def act(action: Command, simulator: Simulator) -> Command:
            gust = rng.random() < strength if discrete else True
            simulator.wind = direction * (1 if discrete else strength) if gust else 0
            return action

        return Dynamics(act, direction=direction)

    return maker


def _setting(names: Sequence[str], factor: float, **drawn: Any) -> Fault:
    """Return a fault that multiplies attributes of the simulator."""

    def act(action: Command, simulator: Simulator) -> Command:
        for name in names:
            simulator.scale(name, factor)
        return action

    return Dynamics(act, **drawn)


def _larger(attribute: str) -> _Maker:
    return lambda _environment, strength, *_: _setting([attribute], 1 + strength)


def choose_attributes(environment: str, rng: np.random.Generator) -> list[str]:
    """Draw a non-empty subset of an environment's components, each subset as likely."""
    known = sorted(VALUES["components"][environment])
    names: list[str] = []
    while not names:
        chosen = rng.random(len(known)) < 0.5
        names = [name for name, use in zip(known, chosen, strict=True) if use]
    return names


def _components(environment: str, strength: float, _: Simulator, rng: Any) -> Fault:
    """Scale a random non-empty subset: lengths and masses grow, powers shrink."""
    names = choose_attributes(environment, rng)
    weaker = any("power" in name for name in VALUES["components"][environment])
    return _setting(names, 1 - strength if weaker else 1 + strength, attributes=names)


def _friction(_: str, strength: float, __: Simulator, ___: np.random.Generator) -> Fault:
    def act(action: Command, simulator: Simulator) -> Command:
        if simulator.nominal("friction"):
            simulator.scale("friction", 1 - strength)
        elif strength:
            simulator.set("friction", strength)
        return action

    return Dynamics(act)


def _gain(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    if environment == "lunarlander":
        engine = ("main_engine_power", "side_engine_power")[rng.integers(2)]
        return _setting([engine], 1 - strength, actuator=engine)
    if info_of(environment).discrete:
        return _setting(["gain"], 1 - strength)
    j = int(rng.integers(info_of(environment).action_dim))
    return Dynamics(lambda a, _: _replaced(a, j, a[j] * (1 - strength)), actuator=j)


def _bias(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    sign = int(rng.choice([-1, 1]))
    if info_of(environment).discrete:

        def push(action: Command, simulator: Simulator) -> Command:
            simulator.set("bias", sign * strength)
            return action

        return Dynamics(push, direction=sign)
    j = int(rng.integers(info_of(environment).action_dim))
    low, high, half = _limits(environment)
    shift, ends = float(sign * strength * half[j]), (float(low[j]), float(high[j]))
    act = lambda a, _: _replaced(a, j, np.clip(a[j] + shift, *ends))  # noqa: E731
    return Dynamics(act, actuator=j, direction=sign)


def _stuck_joint(environment: str, strength: float, _: Simulator, rng: Any) -> Fault:
    """Discrete: with a probability the first command is carried out again."""
    info = info_of(environment)
    first: list[Command] = []
    j = int(rng.integers(info.action_dim))

    def act(action: Command, _: Simulator) -> Command:
        if not first:
            first.append(action if info.discrete else float(action[j]))
        if info.discrete:
            return first[0] if rng.random() < strength else action
        return _replaced(action, j, (1 - strength) * action[j] + strength * first[0])

    return Dynamics(act, **({} if info.discrete else {"actuator": j}))


def _latency(environment: str, strength: float, _: Simulator, rng: np.random.Generator) -> Fault:
    """Between two whole numbers of steps: the mean of both commands, discrete: one by chance."""
    discrete, whole, part = info_of(environment).discrete, int(strength), strength % 1
    recent: deque[Command] = deque(maxlen=whole + 2)

    def act(action: Command, _: Simulator) -> Command:
        recent.append(action)
        newer, older = recent[max(-1 - whole, -len(recent))], recent[max(-2 - whole, -len(recent))]
        if discrete:
            return older if rng.random() < part else newer
        return ((1 - part) * newer + part * older).astype(np.float32) if part else newer

    return Dynamics(act)


def _action_noise(environment: str, strength: float, _: Simulator, rng: Any) -> Fault:
    """Discrete: with a probability the command is drawn at random."""
    info = info_of(environment)

    def act(action: Command, _: Simulator) -> Command:
        if info.discrete:
            other, chance = int(rng.integers(info.action_dim)), rng.random()
            return other if chance < strength else action
        low, high, half = _limits(environment)
        noise = strength * half * rng.normal(size=info.action_dim)
        return np.clip(action + noise, low, high).astype(np.float32) if strength else action

    return Dynamics(act)


def _limits(environment: str) -> tuple[NDArray[np.float64], ...]:
    """Return the lowest and highest value of each action, and half of the way between them."""
    low, high = map(np.array, info_of(environment).limits)
    return low, high, (high - low) / 2


def _replaced(action: Row, j: int, value: float) -> Row:
    changed = action.copy()
    changed[j] = value
    return changed


MAKERS: Final[dict[str, _Maker]] = {
    "iid": _noise,
    "calibration": _calibration,
    "drift": _drift,
    "shutdown": _shutdown,
    "wind-l2r": _wind(1),
    "wind-r2l": _wind(-1),
    "gravity": _larger("gravity"),
    "components": _components,
    "ar1": _ar1,
    "varma": _varma,
    "delay": _delay,
    "stuck": _stuck,
    "gain": _gain,
    "bias": _bias,
    "stuck-joint": _stuck_joint,
    "latency": _latency,
    "action-noise": _action_noise,
    "mass": _larger("body_mass"),
    "friction": _friction,
    "iid-intermittent": _noise,
    "calibration-intermittent": _calibration,
    "shutdown-intermittent": _shutdown,
    "wind-intermittent": _wind(1),
    "gain-intermittent": _gain,
}
"""Makers of the benchmark's faults by kind."""
