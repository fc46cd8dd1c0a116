"""Readings of a watchdog in the logs of stable-baselines3, in training and in evaluation.

The environments are wrapped in `oodd_live.WatchdogWrapper`, so that the info of each step has
a reading. Then ::

    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy

    callback = WatchdogCallback()
    model.learn(10_000, callback=callback)              # logs oodd/alarms and oodd/statistic
    evaluate_policy(model, env, callback=callback.on_evaluation)
    print(callback.evaluated)                           # row of the first alarm, by episode

It takes no more than the documented `stable_baselines3.common.callbacks.BaseCallback`.
"""

from __future__ import annotations

from stable_baselines3.common.callbacks import BaseCallback


class WatchdogCallback(BaseCallback):
    """Logs how many steps had an alarm, and stops training at an alarm if asked to.

    Parameters
    ----------
    stop
        Whether training ends at the first alarm.
    verbose
        0 for silence, 1 to print the reading of each new alarm.
    """

    def __init__(self, *, stop=False, verbose=0):
        super().__init__(verbose)
        self.stop = stop
        self.evaluated = []
        self._alarmed = set()

    def _on_step(self):
        """Look at the readings of all environments; return False to stop training."""
        readings = [info["oodd"] for info in self.locals["infos"] if "oodd" in info]
        if not readings:
            return True
        alarms = {i for i, reading in enumerate(readings) if reading.alarm}
        self.logger.record_mean("oodd/alarms", len(alarms) / len(readings))
        self.logger.record_mean(
            "oodd/statistic", sum(reading.statistic for reading in readings) / len(readings)
        )
        if self.verbose:
            for i in sorted(alarms - self._alarmed):
                print(f"environment {i}, {readings[i]}")
        self._alarmed = alarms
        return not (self.stop and alarms)

    def on_evaluation(self, local, _globals):
        """Keep, for each episode of `evaluate_policy`, the row of its first alarm or None."""
        reading = local["info"].get("oodd")
        if reading is None:
            return
        if reading.t == 1 or not self.evaluated:
            self.evaluated.append(None)
        if reading.alarm and self.evaluated[-1] is None:
            self.evaluated[-1] = reading.t
