"""Gymnasium's Acrobot and CartPole, whose dynamics can be changed."""

import math
from typing import Any, ClassVar

from oodd_recording.simulator import Simulator, importing

with importing("gym"):
    from gymnasium.envs.classic_control.acrobot import AcrobotEnv
    from gymnasium.envs.classic_control.cartpole import CartPoleEnv


class _Acrobot(AcrobotEnv):
    """Acrobot whose gravity can be changed: the stock equations hold it as a local constant."""

    # They stay in force until then; after, the same pendulum is solved from its mass matrix, with
    # `friction` in both joints, in 1/s.

    gravity, friction = 9.8, 0.0

    def _dsdt(self, s_augmented: Any) -> Any:
        if (self.gravity, self.friction) == (_Acrobot.gravity, _Acrobot.friction):
            return super()._dsdt(s_augmented)  # type: ignore[no-untyped-call]
        return self.derivative(s_augmented)

    def derivative(self, state: Any) -> tuple[float, float, float, float, float]:
        """Solve Lagrange's equations M(theta2) dω + c(theta, ω) = (0, torque) for (ω, dω, 0)."""
        theta1, theta2, omega1, omega2, torque = state
        m1, m2, l1 = self.LINK_MASS_1, self.LINK_MASS_2, self.LINK_LENGTH_1
        lc1, lc2, inertia, g = self.LINK_COM_POS_1, self.LINK_COM_POS_2, self.LINK_MOI, self.gravity
        coupling = m2 * l1 * lc2
        m22 = m2 * lc2**2 + inertia
        m12 = m22 + coupling * math.cos(theta2)
        m11 = m1 * lc1**2 + inertia + m2 * l1**2 + m12 + coupling * math.cos(theta2)
        # cos(angle - pi/2) = sin(angle): angles are measured from the downward vertical.
        weight2 = m2 * lc2 * g * math.sin(theta1 + theta2)
        weight1 = (m1 * lc1 + m2 * l1) * g * math.sin(theta1) + weight2
        swirl = coupling * math.sin(theta2)
        c1 = weight1 - swirl * omega2 * (omega2 + 2 * omega1)
        c2 = weight2 + swirl * omega1**2
        determinant = m11 * m22 - m12**2
        acceleration1 = (-c1 * m22 - m12 * (torque - c2)) / determinant
        acceleration2 = (m11 * (torque - c2) + m12 * c1) / determinant
        drag1, drag2 = self.friction * omega1, self.friction * omega2
        return omega1, omega2, acceleration1 - drag1, acceleration2 - drag2, 0.0


class Acrobot(Simulator):
    """Acrobot-v1: torque on the joint between two links; wind adds torque of its own sign."""

    names: ClassVar = {
        f"link_{w}_{i}": f"LINK_{w.upper()}_{i}" for w in ("mass", "length") for i in "12"
    }

    def __init__(self) -> None:
        super().__init__(_Acrobot())

    def command(self, action: int) -> int:
        # Per instance: action 0 is torque -1, action 2 is torque +1.
        torques = {0: [-1.0, 0.0, 1.0], 1: [0.0, 0.0, 2.0], -1: [-2.0, 0.0, 0.0]}
        self.env.AVAIL_TORQUE = [self.gain * t + self.bias for t in torques[int(self.wind)]]
        return int(action)

    def set(self, attribute: str, value: float) -> None:
        if attribute in {"gain", "bias"}:
            setattr(self, attribute, value)
        elif attribute == "body_mass":  # both links weigh the same
            self.env.LINK_MASS_1 = self.env.LINK_MASS_2 = value / 2
        else:
            super().set(attribute, value)
        if attribute.startswith("link_length_"):  # the centre of mass follows
            setattr(self.env, f"LINK_COM_POS_{attribute[-1]}", value / 2)

    def get(self, attribute: str) -> float:
        if attribute in {"gain", "bias"}:
            return float(getattr(self, attribute))
        if attribute == "body_mass":
            return float(self.env.LINK_MASS_1 + self.env.LINK_MASS_2)
        if attribute.startswith("link_length_"):
            return 2 * float(getattr(self.env, f"LINK_COM_POS_{attribute[-1]}"))
        return super().get(attribute)


class CartPole(Simulator):
    """CartPole-v1: a push of 10 N to the left or right; wind takes pushes away or doubles them."""

    names: ClassVar = {"pole_length": "length", "pole_mass": "masspole", "body_mass": "masscart"}

    def __init__(self) -> None:
        super().__init__(CartPoleEnv())
        self._force, self._friction = self.env.force_mag, 0.0

    def command(self, action: int) -> int:
        direction = 1 if action == 1 else -1
        force = self._force * (1 + self.wind * direction) * self.gain
        # The environment gives the force the direction of the action.
        push = self._force * self.bias - self._friction * float(self.env.state[1])
        self.env.force_mag = force + direction * push
        return int(action)

    def set(self, attribute: str, value: float) -> None:
        if attribute in {"gain", "bias"}:
            setattr(self, attribute, value)
            return
        if attribute == "friction":  # of the track, in N s/m
            self._friction = value
            return
        super().set(attribute, value)
        env = self.env  # computes two quantities once
        env.total_mass = env.masspole + env.masscart
        env.polemass_length = env.masspole * env.length

    def get(self, attribute: str) -> float:
        if attribute in {"gain", "bias"}:
            return float(getattr(self, attribute))
        if attribute == "friction":
            return self._friction
        if attribute == "pole_length":
            return float(self.env.polemass_length / self.env.masspole)
        if attribute == "pole_mass":
            return float(self.env.total_mass - self.env.masscart)
        return super().get(attribute)
