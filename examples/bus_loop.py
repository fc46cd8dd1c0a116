"""A watchdog in a 50 Hz loop whose sensors come by a bus, as on a robot with ROS.

``python examples/bus_loop.py --fault stuck`` (extra gym).

Every sensor of Gymnasium's CartPole publishes to a topic of its own. The loop wakes up 50 times a
second, takes what has come since it last did, and hands that to the watchdog: a sensor from which
nothing new came in time is missing. From a chosen step on one topic has a fault, or the loop is too
slow and sees only every second message, which their time stamps show.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import time

import gymnasium
import numpy as np
from oodd_live import TerminalMonitor, Watchdog
from oodd_recording.policies import load_policy

from oodd_eval import load_split
from oodd_eval.errors import OoddError

RATE = 50
NAMING = 10
"""Rows after an alarm in which a fault may still get its name."""
FAULTS = ("silent", "stuck", "nan", "skipping")
PARAMETERS = {"panel": {"forecast": "linear"}}
"""Of the default, which would train networks for most of a minute otherwise."""


class Bus:
    """The newest message of each topic with its number, as a ROS subscriber would keep it."""

    def __init__(self):
        self._newest = {}

    def publish(self, topic, number, value):
        """Keep a message in place of the one before."""
        self._newest[topic] = number, value

    def newer(self, topics, number):
        """Return the values, by topic, of messages that are at least this new."""
        found = {topic: self._newest.get(topic, (-1, math.nan)) for topic in topics}
        return {topic: value for topic, (n, value) in found.items() if n >= number}


class Robot:
    """A cart with its controller, which publishes what its sensors measure, or a fault instead."""

    def __init__(self, bus, sensors, fault, topic, onset, seed):
        self.bus, self.sensors = bus, sensors
        self.fault, self.topic, self.onset = fault, topic, onset
        self.env, self.policy = gymnasium.make("CartPole-v1"), load_policy("cartpole")
        self.observation, _ = self.env.reset(seed=seed)
        self.t, self.command, self.over, self._stuck = 0, None, False, 0.0
        self._publish()

    def step(self):
        """Let 20 ms pass, or 40 where the loop skips a message."""
        self._act()
        if self.fault == "skipping" and self.t >= self.onset and not self.over:
            self._act()
        self._publish()

    def _act(self):
        action = self.policy.act(self.observation)
        self.command = np.eye(2, dtype=np.float32)[action]
        self.observation, _, self.over, *_ = self.env.step(action)
        self.t += 1

    def _publish(self):
        for topic, value in zip(self.sensors, self.observation.tolist(), strict=True):
            faulty = topic == self.topic and self.t >= self.onset
            if faulty and self.fault == "silent":
                continue
            broken = {"stuck": self._stuck, "nan": math.nan}.get(self.fault, value)
            self.bus.publish(topic, self.t, broken if faulty else value)
            if topic == self.topic and self.t < self.onset:
                self._stuck = value


def main(arguments=None):
    """Watch one episode; return the reading that names what is at fault, or None."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--detector", default="panel", help="of `oodd-eval list detectors` (default: panel)"
    )
    parser.add_argument(
        "--fault", choices=(*FAULTS, "none"), default="stuck", help="what happens (default: stuck)"
    )
    parser.add_argument(
        "--topic", default="pole angle", help="the sensor with the fault (default: pole angle)"
    )
    parser.add_argument("--onset", type=int, default=100, help="step of the fault (default: 100)")
    parser.add_argument("--steps", type=int, default=200, help="at most so many (default: 200)")
    parser.add_argument("--seed", type=int, default=7, help="of the cart's start (default: 7)")
    parser.add_argument("--fast", action="store_true", help="do not wait for the clock")
    parser.add_argument("--monitor", action="store_true", help="show the readings as they come")
    options = parser.parse_args(arguments)
    data = load_split("mini").environment("cartpole")
    topics = [sensor.name for sensor in data.sensors]
    if options.topic not in topics:
        parser.error(f"--topic {options.topic!r}, expected one of {', '.join(topics)}")
    parameters = PARAMETERS.get(options.detector)
    episodes = f"{len(data.train)} nominal episodes of CartPole"
    print(f"fitting {options.detector} on {episodes}, which takes seconds ...", flush=True)
    start = time.monotonic()
    try:
        watchdog = Watchdog.fit(options.detector, data, rate=RATE, parameters=parameters)
    except OoddError as error:  # of a detector that there is not, say
        parser.error(str(error))
    bus = Bus()
    robot = Robot(bus, watchdog.sensors, options.fault, options.topic, options.onset, options.seed)
    print(f"fitted in {time.monotonic() - start:.1f} s; {watchdog.promise}")
    fault = f"{options.topic}: {options.fault} from step {options.onset} on"
    print(f"{options.steps} steps at {RATE} Hz; {'no fault' if options.fault == 'none' else fault}")
    late = 0
    monitor = TerminalMonitor("bus") if options.monitor else contextlib.nullcontext()
    with monitor as shown:
        start = time.monotonic()
        for tick in range(options.steps):
            readings = bus.newer(watchdog.sensors, robot.t)
            reading = watchdog.update(readings or None, robot.command, time=robot.t / RATE)
            if shown:
                shown.update(reading)
            # The alarm comes first, and what the sensor does has a name some rows later.
            named = reading.alarm and (reading.faults or reading.t >= watchdog.raised.t + NAMING)
            if named or robot.over:
                break
            robot.step()
            left = start + (tick + 1) / RATE - time.monotonic()
            late += left < 0
            if not options.fast and left > 0:
                time.sleep(left)
    print(f"{reading}; {late} of {tick + 1} ticks took longer than {1000 // RATE} ms")
    return reading if reading.alarm else None


if __name__ == "__main__":
    main()
