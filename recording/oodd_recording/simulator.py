"""A simulator of one episode, behind one small interface.

A simulator is used for one episode: PyBullet's client and Box2D's world keep hidden state that
makes later episodes differ from first ones with the same seed.
"""

import ctypes
import os
import platform
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.files import redirected
from oodd_eval.errors import MissingExtraError

Row = NDArray[np.float32]
Image = NDArray[np.uint8]


@contextmanager
def quiet_streams() -> Iterator[None]:
    """Send file descriptors 1 and 2 to the null device: PyBullet prints from C, past Python."""
    with Path(os.devnull).open("wb") as null, redirected(null):
        try:
            yield
        finally:
            # C has buffers of its own: their content has to go while the null device is in place.
            ctypes.CDLL(None).fflush(None)


def how_to_install(extra: str) -> str:
    """Return the command that installs the simulators of an extra, and what may hinder it here."""
    command = f"pip install 'oodd-eval[{extra}]'"
    if extra == "bullet" and sys.version_info >= (3, 12):
        return (
            f"PyBullet has no wheel for Python {platform.python_version()}: use Python 3.11, or "
            f"compile it, which {command} does where there is a C++ compiler (ten minutes)"
        )
    return command


@contextmanager
def importing(extra: str) -> Iterator[None]:
    """Import simulators quietly; `MissingExtraError` where one is not installed.

    Box2D's C module warns while it is imported, and crashes where warnings are errors.
    """
    try:
        with quiet_streams(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except ImportError as error:
        raise MissingExtraError(
            f"recording needs the simulators ({error}): {how_to_install(extra)}"
        ) from error


class Simulator:
    """One episode of one environment.

    `wind` is the direction of its pushes, -1, 0 or +1, where actions are discrete; elsewhere it is
    added to every command. `environment` is its name.
    """

    environment = ""
    names: ClassVar[Mapping[str, str]] = {}
    """The environment's names of attributes that it calls otherwise."""

    def __init__(self, env: Any) -> None:
        self.env, self.wind = env, 0.0
        self.gain, self.bias = 1.0, 0.0  # of the actuators, where actions are discrete
        self._nominal: dict[str, float] = {}

    def reset(self, seed: int) -> Row:
        """Start the episode; return the observation of shape (D,)."""
        return np.array(self.env.reset(seed=seed)[0], dtype=np.float32)

    def step(self, action: Any) -> tuple[Row, float, bool]:
        """Advance by one commanded action; return observation, reward and True at the end."""
        row, reward, over, _, _ = self.env.step(self.command(action))
        # A copy: an environment may return the same array again.
        return np.array(row, dtype=np.float32), float(reward), bool(over)

    def command(self, action: Any) -> Any:
        """Return what the environment is given for an action in the present wind."""
        return action

    def set(self, attribute: str, value: float) -> None:
        """Change an attribute of the dynamics from the next step on."""
        setattr(self.env, self.names.get(attribute, attribute), value)

    def get(self, attribute: str) -> float:
        """Read an attribute back from where the simulator itself reads it."""
        return float(getattr(self.env, self.names.get(attribute, attribute)))

    def nominal(self, attribute: str) -> float:
        """Return the value that an attribute had when it was first asked for."""
        return self._nominal.setdefault(attribute, self.get(attribute))

    def scale(self, attribute: str, factor: float) -> None:
        """Make an attribute a multiple of its nominal value, if it is not so already."""
        value = self.nominal(attribute) * factor
        if self.get(attribute) != value:
            self.set(attribute, value)

    def restore(self) -> None:
        """Put the wind, and all attributes that were scaled, back."""
        self.wind = 0.0
        for attribute in self._nominal:
            self.scale(attribute, 1.0)

    def image(self) -> Image:
        """Return a picture of the present state, uint8 of shape (height, width, 3).

        Of an environment that draws none, whatever its ``render`` returns or raises.
        """
        # Those who made the environment wanted no pictures: it learns of the mode only now.
        env = self.env.unwrapped
        env.render_mode = "rgb_array"
        image: Image = env.render()
        return image

    def close(self) -> None:
        """Release what the simulator holds."""
        self.env.close()
