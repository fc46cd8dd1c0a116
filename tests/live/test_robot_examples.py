"""The examples for ROS 2 and MQTT run, with stand-ins for the middleware alone."""

import json
import runpy
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from oodd_live import Watchdog
from oodd_live.reading import ERROR, OK, STALE
from rosbags.typesys import Stores, get_typestore

EXAMPLES = Path(__file__).parents[2] / "examples"
SENSORS = ["position.elbow", "position.wrist", "effort.elbow"]
STORE = get_typestore(Stores.ROS2_HUMBLE)


def arm(seed, rows=60):
    return np.random.default_rng(seed).normal(size=(rows, 3)).cumsum(axis=0) * 0.1


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "arm.npz"
    parts = [[arm(i) for i in numbers] for numbers in (range(20), range(50, 90))]
    Watchdog.fit("mahalanobis", *parts, sensors=SENSORS).save(path)
    return path


def module(monkeypatch, name, **content):
    made = types.ModuleType(name)
    made.__dict__.update(content)
    monkeypatch.setitem(sys.modules, name, made)


class Node:
    """What the example uses of rclpy's: no more than rclpy has."""

    def __init__(self, name):
        self._name, self.published, self.resets, self.seconds = name, [], 0, 1.76e9
        self.callbacks = {}

    def get_name(self):
        return self._name

    def get_clock(self):
        now = types.SimpleNamespace(nanoseconds=round(self.seconds * 1e9))
        return types.SimpleNamespace(now=lambda: now)

    def create_publisher(self, kind, topic, depth):
        assert (kind.__msgtype__, topic) == ("diagnostic_msgs/msg/DiagnosticArray", "/diagnostics")
        return types.SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind, topic, callback, depth):
        self.callbacks[topic] = kind, callback

    def create_timer(self, seconds, callback):
        self.callbacks["timer"] = seconds, callback
        return types.SimpleNamespace(reset=lambda: None)


def status_of_rclpy(level, **fields):
    """A byte is bytes of length 1 in rclpy, and a number in rosbags."""
    assert isinstance(level, bytes)
    return STORE.types["diagnostic_msgs/msg/DiagnosticStatus"](level[0], **fields)


@pytest.fixture
def node(saved, monkeypatch):
    for package in ("builtin_interfaces", "diagnostic_msgs", "sensor_msgs", "std_msgs"):
        prefix = f"{package}/msg/"
        types_ = {n.removeprefix(prefix): t for n, t in STORE.types.items() if n.startswith(prefix)}
        module(monkeypatch, f"{package}.msg", **types_)
    sys.modules["diagnostic_msgs.msg"].DiagnosticStatus = status_of_rclpy
    spun = []
    module(monkeypatch, "rclpy", init=lambda: None, spin=spun.append)
    module(monkeypatch, "rclpy.node", Node=Node)
    monkeypatch.setattr(sys, "argv", ["ros2_node.py", str(saved)])
    runpy.run_path(str(EXAMPLES / "ros2_node.py"), run_name="__main__")
    return spun[0]


def hear(node, names, position, effort=()):
    make, callback = node.callbacks["/joint_states"]
    stamp = STORE.types["builtin_interfaces/msg/Time"](0, 0)
    header = STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    node.seconds += 0.05
    callback(make(header, names, np.array(position), np.array([]), np.array(effort)))


def statuses(node):
    """Statuses as they come out of the wire."""
    name = "diagnostic_msgs/msg/DiagnosticArray"
    wire = [STORE.serialize_cdr(array, name) for array in node.published]
    return [STORE.deserialize_cdr(raw, name).status[0] for raw in wire]


def test_a_ros_node_reads_joints_by_name_and_publishes_diagnostics(node, saved):
    twin, rows = Watchdog.load(saved), arm(100)
    for t, (elbow, wrist, effort) in enumerate(rows):
        # Two publishers, and an order that changes; a gripper that the watchdog does not know.
        hear(node, ["gripper"], [9.9])
        hear(node, ["wrist"], [wrist])
        names = ["elbow", "base"] if t % 2 else ["base", "elbow"]
        order = 1 if t % 2 else -1
        hear(node, names, [elbow, 7.0][::order], [effort, 8.0][::order])
    node.callbacks["timer"][1]()
    expected = [twin.update(row) for row in rows]
    told = statuses(node)
    assert [s.message for s in told] == [str(reading) for reading in expected]
    assert {s.level for s in told} == {OK}
    assert told[-1].name == "oodd_watchdog"
    for wrist in np.linspace(0, 90, 10):
        hear(node, ["elbow", "wrist"], [rows[-1][0], wrist], [rows[-1][2]])
    assert statuses(node)[-1].level == ERROR
    for _ in range(6):
        node.seconds += 1
        node.callbacks["timer"][1]()
    assert statuses(node)[-1].level == STALE


class Client:
    """What the example uses of paho's client, without a broker."""

    made = ()

    def __init__(self, version):
        assert version == 2
        self.published, self.subscribed, self.will = [], [], None
        Client.made = (*Client.made, self)

    def will_set(self, topic, payload, qos, retain):
        self.will = topic, payload

    def connect(self, host):
        self.host = host

    def loop_forever(self):
        self.on_connect(self, None, {}, types.SimpleNamespace(is_failure=False), None)

    def subscribe(self, topic, qos):
        self.subscribed.append(topic)

    def publish(self, topic, payload, qos, retain):
        assert (qos, retain) == (1, True)
        self.published.append(json.loads(payload, parse_constant=pytest.fail))

    def hear(self, payload):
        self.on_message(self, None, types.SimpleNamespace(payload=payload))


def test_a_sink_of_mqtt_judges_rows_and_publishes_changes(saved, monkeypatch):
    versions = types.SimpleNamespace(VERSION2=2)
    module(monkeypatch, "paho.mqtt.client", Client=Client, CallbackAPIVersion=versions)
    for name in ("paho", "paho.mqtt"):
        module(monkeypatch, name)
    sys.modules["paho.mqtt"].client = sys.modules["paho.mqtt.client"]
    monkeypatch.setattr(sys, "argv", ["mqtt_sink.py", str(saved), "--host", "broker"])
    runpy.run_path(str(EXAMPLES / "mqtt_sink.py"), run_name="__main__")
    client = Client.made[-1]
    assert (client.host, client.subscribed) == ("broker", ["robot/readings"])
    assert json.loads(client.will[1]) == {"level": STALE}
    for row in arm(100):
        client.hear(json.dumps(dict(zip(SENSORS, row, strict=True)) | {"other": "x"}))
    assert [status["level"] for status in client.published] == [OK]
    for row in arm(101):
        client.hear(json.dumps({SENSORS[0]: row[0], SENSORS[1]: None, SENSORS[2]: "broken"}))
    assert client.published[-1]["level"] == ERROR
    assert "position.wrist missing, effort.elbow missing" in client.published[-1]["message"]
    for payload in (b"\xff", b"[1, 2]", b"{", b"null", b"7", b'"x"'):
        client.hear(payload)
    assert client.published[-1]["level"] == STALE
    refused = types.SimpleNamespace(is_failure=True)
    with pytest.raises(SystemExit):
        client.on_connect(client, None, {}, refused, None)
