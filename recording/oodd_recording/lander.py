"""Gymnasium's LunarLander on Box2D, whose dynamics can be changed."""

import types

from oodd_recording.simulator import Simulator, importing

with importing("gym"):
    from gymnasium.envs.box2d import lunar_lander


class LunarLander(Simulator):
    """LunarLander-v3: engines 1 and 3 push to -x and +x; wind doubles one and stops the other."""

    def __init__(self) -> None:
        super().__init__(lunar_lander.LunarLander())
        # Engine powers are globals of the module: this instance's step gets a copy of its own.
        self._globals = dict(vars(lunar_lander))
        step = lunar_lander.LunarLander.step
        own_step = types.FunctionType(step.__code__, self._globals, closure=step.__closure__)
        setattr(self.env, "step", types.MethodType(own_step, self.env))  # noqa: B010  # for mypy
        self._side_power = self._nominal_side = float(self._globals["SIDE_ENGINE_POWER"])

    def command(self, action: int) -> int:
        push = {1: -1, 3: 1}.get(int(action), 0)
        self._globals["SIDE_ENGINE_POWER"] = self._side_power * (2 if push * self.wind > 0 else 1)
        if self.bias:
            lander = self.env.lander
            side = self._nominal_side * self.bias
            lander.ApplyLinearImpulse((side, 0.0), lander.worldCenter, True)
        return 0 if push * self.wind < 0 else int(action)

    def set(self, attribute: str, value: float) -> None:
        if attribute == "gravity":
            # The environment reads its gravity at reset only; the world's acts at once.
            self.env.world.gravity = (0.0, -value)
            return
        if attribute == "bias":  # in pushes of a side engine
            self.bias = value
            return
        if attribute == "body_mass":
            data, lander = self.env.lander.massData, self.env.lander
            data.I, data.mass = data.I * value / data.mass, value
            lander.massData = data
            return
        if attribute == "friction":
            for fixture in self.env.moon.fixtures[1:]:  # the first one lies below the ground
                fixture.friction = value
            return
        self._globals[attribute.upper()] = value
        self._side_power = value if attribute == "side_engine_power" else self._side_power

    def get(self, attribute: str) -> float:
        if attribute == "gravity":
            return -float(self.env.world.gravity[1])
        if attribute == "bias":
            return self.bias
        if attribute == "body_mass":
            return float(self.env.lander.mass)
        if attribute == "friction":
            return float(self.env.moon.fixtures[1].friction)
        return float(self._globals[attribute.upper()])
