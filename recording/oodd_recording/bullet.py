"""The four robots on PyBullet, whose dynamics can be changed."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from oodd_recording.simulator import Image, Row, Simulator, importing, quiet_streams

with importing("bullet"):
    import pybullet
    import pybullet_envs_gymnasium.gym_locomotion_envs as bullet


_FUNCTIONS = {
    name: function
    for name, function in vars(pybullet).items()
    if inspect.isbuiltin(function) and name != "disconnect"  # the client keeps track of this one
}


class Bullet(Simulator):
    """One of the four PyBullet robots in a client of its own; wind adds to every motor command."""

    def __init__(self, make_env: Callable[[], Any]) -> None:
        super().__init__(make_env())

    def reset(self, seed: int) -> Row:
        with quiet_streams():
            row = super().reset(seed)
        # The client binds a function to itself whenever one is called, some twenty times a step.
        client = self.env._p  # noqa: SLF001  # the simulator's only handle
        for name, function in _FUNCTIONS.items():
            setattr(client, name, functools.partial(function, physicsClientId=client._client))  # noqa: SLF001
        return row

    def command(self, action: Row) -> Row:
        return np.clip(action + np.float32(self.wind), -1, 1) if self.wind else action

    def set(self, attribute: str, value: float) -> None:
        client = self.env._p  # noqa: SLF001  # the simulator's only handle
        if attribute == "gravity":
            client.setGravity(0, 0, -value)
        elif attribute == "body_mass":
            client.changeDynamics(*self._torso(), mass=value)
        elif attribute == "friction":
            for body in self.env.stadium_scene.ground_plane_mjcf:
                client.changeDynamics(body, -1, lateralFriction=value)
        else:
            self.env.robot.power = value

    def get(self, attribute: str) -> float:
        client = self.env._p  # noqa: SLF001  # the simulator's only handle
        if attribute == "gravity":
            return -float(client.getPhysicsEngineParameters()["gravityAccelerationZ"])
        if attribute == "body_mass":
            return float(client.getDynamicsInfo(*self._torso())[0])
        if attribute == "friction":
            ground = self.env.stadium_scene.ground_plane_mjcf[0]
            return float(client.getDynamicsInfo(ground, -1)[1])
        return float(self.env.robot.power)

    def _torso(self) -> tuple[int, int]:
        part = self.env.robot.parts["torso"]
        return part.bodies[part.bodyIndex], part.bodyPartIndex

    def image(self) -> Image:
        client = self.env._p  # noqa: SLF001  # the simulator's only handle
        view = client.computeViewMatrixFromYawPitchRoll(self.env.robot.body_xyz, 2.8, 30, -25, 0, 2)
        lens = client.computeProjectionMatrixFOV(45, 4 / 3, 0.1, 50)
        width, height, pixels, _, _ = client.getCameraImage(
            320, 240, view, lens, renderer=client.ER_TINY_RENDERER
        )
        return np.array(pixels, np.uint8).reshape(height, width, 4)[..., :3]

    def close(self) -> None:
        with quiet_streams():
            super().close()


ROBOTS: Final = {
    "ant": bullet.AntBulletEnv,
    "halfcheetah": bullet.HalfCheetahBulletEnv,
    "hopper": bullet.HopperBulletEnv,
    "walker2d": bullet.Walker2DBulletEnv,
}
"""Makers of the robots' environments."""
