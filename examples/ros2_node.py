"""A watchdog as a ROS 2 node: joint states by the names of the joints in, diagnostics out.

``python examples/ros2_node.py arm.npz`` where ROS is sourced. The file is a watchdog that was saved
(`Watchdog.save`), with sensors such as ``position.elbow`` and ``effort.elbow``, as an import of a
bag with /joint_states names them. The tests run this without ROS, against its message types.
"""

import sys

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from oodd_live import Watchdog
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

SILENCE = 0.5  # seconds after which a reading is missing


class WatchdogNode(Node):
    """Judges a row whenever a joint reports anew, so that several nodes may publish joints."""

    def __init__(self, watchdog):
        super().__init__("oodd_watchdog")
        self.watchdog, self.newest, self.heard = watchdog, {}, set()
        self.publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_subscription(JointState, "/joint_states", self.hear, 10)
        self.timer = self.create_timer(SILENCE, self.judge)

    def hear(self, joints):
        """Take the readings of a message by the names in it: their order may change."""
        readings = {
            f"{field}.{name}": (self.now(), value)
            for field in ("position", "velocity", "effort")
            for name, value in zip(joints.name, getattr(joints, field), strict=False)  # maybe none
        }
        readings = {name: readings[name] for name in self.watchdog.sensors if name in readings}
        if self.heard & readings.keys():
            self.judge()
        self.heard |= readings.keys()
        self.newest |= readings

    def judge(self):
        """Judge the newest readings, and publish what the watchdog says."""
        self.heard = set()
        self.timer.reset()
        now = self.now()
        row = {name: value for name, (t, value) in self.newest.items() if now - t <= SILENCE}
        array = self.watchdog.update(row or None).diagnostics(self.get_name(), time=now)
        (status,) = array["status"]
        status["level"] = bytes([status["level"]])  # as rclpy has a byte
        status["values"] = [KeyValue(**pair) for pair in status["values"]]
        header = Header(stamp=Time(**array["header"]["stamp"]), frame_id="")
        self.publisher.publish(DiagnosticArray(header=header, status=[DiagnosticStatus(**status)]))

    def now(self):
        """Return the time of the node's clock in seconds."""
        return self.get_clock().now().nanoseconds / 1e9


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(WatchdogNode(Watchdog.load(sys.argv[1])))
