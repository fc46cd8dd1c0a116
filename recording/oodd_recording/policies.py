"""Frozen nominal policies: arrays in npz files, provenance in a JSON file beside them.

A policy is deterministic: its forward pass runs in float64, and is rounded to a grid of 2^-16 so
that the last bits of a matrix product cannot reach the simulator.
"""

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import POLICY, read_bytes, read_npz
from oodd_eval.data.facts import EnvironmentInfo
from oodd_eval.data.layout import content_digest
from oodd_eval.data.registry import environment_spec
from oodd_eval.errors import PolicyError
from oodd_recording.mlp import Layers
from oodd_recording.registered import code_digest, info_of

ACTION_GRID: Final = 2.0**16
LAYERS: Final = {
    "TD3": ("W1", "b1", "W2", "b2", "W3", "b3"),
    "IQN": ("W1", "b1", "W2", "b2", "C", "c", "W3", "b3", "W4", "b4", "quantiles"),
}
"""Arrays that a policy file of each algorithm holds."""

Arrays = Mapping[str, NDArray[Any]]


def scaled(action: NDArray[np.float32], info: EnvironmentInfo) -> NDArray[np.float32]:
    """Return an action from -1 to 1, (A,), in the units of an environment."""
    if not info.low or set(info.low + info.high) == {-1.0, 1.0}:
        return action
    low, high = map(np.array, info.limits)
    return np.asarray(low + (action + 1.0) / 2 * (high - low), np.float32)


class TD3Policy:
    """tanh(relu(relu(o W1 + b1) W2 + b2) W3 + b3): the actor of TD3 (Fujimoto et al. 2018).

    Its actions from -1 to 1 are scaled to the environment's.
    """

    def __init__(self, info: EnvironmentInfo, arrays: Arrays) -> None:
        self.digest, self._info = policy_digest(arrays), info
        self._layers = [np.asarray(arrays[name], dtype=np.float64) for name in LAYERS["TD3"]]

    def act(self, row: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action for an observation row of shape (D,): float32 of shape (A,)."""
        w1, b1, w2, b2, w3, b3 = self._layers
        hidden = np.maximum(row.astype(np.float64) @ w1 + b1, 0)
        hidden = np.maximum(hidden @ w2 + b2, 0)
        action = np.tanh(hidden @ w3 + b3)
        rounded = (np.rint(action * ACTION_GRID) / ACTION_GRID).astype(np.float32)
        return scaled(rounded, self._info)


class IQNPolicy:
    """Greedy in the mean of implicit quantiles (Dabney et al. 2018) at fixed midpoints.

    ``psi = relu(relu(o W1 + b1) W2 + b2)``, ``phi_k = relu(cos(pi i tau_k) C + c)`` with
    ``tau_k = (2k + 1) / 2K``, ``Q = mean_k [relu((psi phi_k) W3 + b3) W4 + b4]``.
    """

    def __init__(self, arrays: Arrays) -> None:
        self.digest = policy_digest(arrays)
        w = {name: np.asarray(arrays[name], dtype=np.float64) for name in LAYERS["IQN"]}
        count = int(arrays["quantiles"])
        tau = (2 * np.arange(count) + 1) / (2 * count)
        cosines = np.cos(np.pi * np.arange(len(w["C"])) * tau[:, None])
        self._phi = np.maximum(cosines @ w["C"] + w["c"], 0)
        self._w = w

    def values(self, row: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the mean return of each action, of shape (A,)."""
        w = self._w
        psi = np.maximum(row.astype(np.float64) @ w["W1"] + w["b1"], 0)
        psi = np.maximum(psi @ w["W2"] + w["b2"], 0)
        hidden = np.maximum((psi * self._phi) @ w["W3"] + w["b3"], 0)
        q: NDArray[np.float64] = hidden.mean(axis=0) @ w["W4"] + w["b4"]
        return q

    def act(self, row: NDArray[np.float32]) -> int:
        """Return the action for an observation row of shape (D,)."""
        # Rounded like continuous actions, so that ties are ties on every processor.
        return int(np.argmax(np.round(self.values(row) * ACTION_GRID)))


class CustomPolicy:
    """A controller that the spec of a custom environment names.

    It is a function of the row, or an object with ``act(row)`` and ``reset()``, which may have
    memory.
    """

    def __init__(self, environment: str, controller: Any) -> None:
        self.digest = code_digest(environment, ())
        self._discrete = info_of(environment).discrete
        self._act: Callable[[Any], Any] = getattr(controller, "act", controller)
        self._reset: Callable[[], Any] | None = getattr(controller, "reset", None)

    @property
    def has_memory(self) -> bool:
        """Whether an action may depend on earlier rows."""
        return self._reset is not None

    def reset(self) -> None:
        """Forget all rows: an episode begins."""
        if self._reset is not None:
            self._reset()

    def act(self, row: NDArray[np.float32]) -> Any:
        """Return the action for the next observation row, (D,): an int, or a float32 row."""
        # Copies: controllers may write into what they get, and use what they return again.
        action = self._act(row.copy())
        return int(action) if self._discrete else np.array(action, np.float32).ravel()


class ImportedPolicy:
    """A policy of another project: its outputs are actions in their units, or values of each."""

    def __init__(
        self, environment: str, outputs: Callable[[NDArray[np.float32]], Any], digest: str
    ) -> None:
        info = info_of(environment)
        self.digest, self._outputs, self._discrete = digest, outputs, info.discrete
        self._low, self._high = map(np.array, info.limits)

    def act(self, row: NDArray[np.float32]) -> Any:
        """Return the action for an observation row of shape (D,): an int, or a float32 row."""
        outputs = np.asarray(self._outputs(row), np.float64).reshape(-1)
        if not np.isfinite(outputs).all():
            raise PolicyError(f"an imported policy gives {outputs} for the row {row}")
        rounded = np.rint(outputs * ACTION_GRID) / ACTION_GRID
        if self._discrete:
            return int(np.argmax(rounded))
        return np.clip(rounded, self._low, self._high).astype(np.float32)


Policy = TD3Policy | IQNPolicy | CustomPolicy | ImportedPolicy  # deterministic controllers


def policy_digest(arrays: Arrays) -> str:
    """Return the digest of a policy's arrays, see `content_digest`."""
    return content_digest({name: np.atleast_1d(array) for name, array in arrays.items()})


def load_policy(environment: str, path: str | Path | None = None) -> Policy:
    """Load the frozen policy of an environment, or another file; `PolicyError` if it is none."""
    spec, info = environment_spec(environment), info_of(environment)
    if path is None and callable(spec.policy):
        return CustomPolicy(environment, spec.policy())
    file = Path(path or str(spec.policy))
    if not file.exists():
        raise PolicyError(
            f"{file.name} does not exist: train it, `oodd-eval policies train {environment}`"
        )
    if file.suffix == ".onnx":
        return _graph(environment, file)
    arrays = read_npz(file, POLICY)
    if "steps" in arrays:
        return layer_policy(file.name, environment, arrays)
    return make_policy(file.name, info, arrays)


def layer_policy(file: str, environment: str, arrays: Arrays) -> ImportedPolicy:
    """Return a policy of plain layers; `PolicyError` where they do not fit the environment."""
    info = info_of(environment)
    try:
        layers = Layers(arrays)
        layers(np.zeros(info.observation_dim, np.float32))
    except (ValueError, KeyError) as error:
        raise PolicyError(f"{file} holds no policy of layers that fit: {error}") from error
    _check_widths(file, layers.widths, info)
    return ImportedPolicy(environment, layers, policy_digest(arrays))


def _graph(environment: str, file: Path) -> ImportedPolicy:
    from oodd_recording.onnx_files import session_of  # noqa: PLC0415  of an extra

    info, run = info_of(environment), session_of(file)
    digest = hashlib.sha256(read_bytes(file, POLICY.most, PolicyError)).hexdigest()
    try:
        width = len(run(np.zeros(info.observation_dim, np.float32)))
    except Exception as error:  # onnxruntime's errors have no common base
        text = str(error).partition("\n")[0]
        raise PolicyError(f"{file.name} cannot act in {environment}: {text:.200}") from error
    _check_widths(file.name, (info.observation_dim, width), info)
    return ImportedPolicy(environment, run, digest)


def _check_widths(file: str, widths: tuple[int, int], info: EnvironmentInfo) -> None:
    if widths != (info.observation_dim, info.action_dim):
        raise PolicyError(
            f"{file} maps {widths[0]} sensors to {widths[1]} actions, expected "
            f"{info.observation_dim} and {info.action_dim} for {info.id}"
        )


def make_policy(file: str, info: EnvironmentInfo, arrays: Arrays) -> Policy:
    """Return a policy for an environment; `PolicyError` unless the arrays of a file are one."""
    if missing := ", ".join(name for name in LAYERS[info.policy] if name not in arrays):
        raise PolicyError(f"{file} lacks the arrays {missing} of a {info.policy} policy")
    last = arrays["b3"] if info.policy == "TD3" else arrays["b4"]
    widths = (len(np.atleast_1d(arrays["W1"])), np.atleast_1d(last).shape[-1])
    _check_widths(file, widths, info)
    if bad := [name for name, a in arrays.items() if not np.isfinite(a).all()]:
        raise PolicyError(f"{file} holds values that are not finite in {', '.join(bad)}")
    try:
        policy: Policy = TD3Policy(info, arrays) if info.policy == "TD3" else IQNPolicy(arrays)
        policy.act(np.zeros(info.observation_dim, np.float32))
    except (ValueError, TypeError, IndexError) as error:
        raise PolicyError(f"{file} holds layers that do not fit one another: {error}") from error
    return policy
