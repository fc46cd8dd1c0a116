"""A watchdog between topics of MQTT: readings come in as JSON, a status goes out as JSON.

``python examples/mqtt_sink.py arm.npz --host broker`` (pip install "paho-mqtt>=2"). The file is a
watchdog that was saved (`Watchdog.save`). A message such as ``{"torque": 1.2, "speed": null}`` is a
row. A status is published when its level changes, and retained for who subscribes later. The tests
run this without a broker.
"""

import argparse
import json
import time

import paho.mqtt.client as mqtt
from oodd_live import Watchdog
from oodd_live.reading import STALE


class Sink:
    """Judges rows as they come."""

    def __init__(self, watchdog, client, source, target):
        self.watchdog, self.source, self.target, self.level = watchdog, source, target, None
        client.on_connect, client.on_message = self.subscribe, self.judge
        client.will_set(target, json.dumps({"level": STALE}), qos=1, retain=True)

    def subscribe(self, client, _userdata, _flags, reason, _properties):
        """Subscribe, after a lost connection too."""
        if reason.is_failure:
            raise SystemExit(f"the broker refuses: {reason}")
        client.subscribe(self.source, qos=1)

    def judge(self, client, _userdata, message):
        """Judge a row: what is no object has no readings, what is no number is missing."""
        try:
            sent = dict(json.loads(message.payload))
        except (TypeError, ValueError):
            sent = {}
        values = {name: sent.get(name) for name in self.watchdog.sensors}
        row = {name: value for name, value in values.items() if isinstance(value, int | float)}
        reading = self.watchdog.update(row or None)
        (status,) = reading.diagnostics(self.target, time=time.time())["status"]
        if status["level"] != self.level:
            self.level = status["level"]
            client.publish(self.target, json.dumps(status), qos=1, retain=True)


def main():
    """Connect, and judge until interrupted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", help="a saved watchdog")
    parser.add_argument("--host", default="localhost")
    parser.add_argument("--source", default="robot/readings", help="topic of the rows")
    parser.add_argument("--target", default="robot/diagnostics", help="topic of the status")
    options = parser.parse_args()
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    Sink(Watchdog.load(options.file), client, options.source, options.target)
    client.connect(options.host)
    client.loop_forever()


if __name__ == "__main__":
    main()
