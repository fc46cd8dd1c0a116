"""temporary"""

from oodd_interventions.sensor import VirtualSensor
from oodd_interventions.situation import ActSpec


class Mask:
    def __init__(self, situation):
        self.situation, self.sensor = situation, VirtualSensor(situation)

    def act(self, row):
        return self.situation.policy.act(self.sensor.row(row))


ACTS = [ActSpec("mask", Mask, "masks", ("sensor",))]


def failed(environment, rewards, terminated, cap, row):
    return bool(terminated)
