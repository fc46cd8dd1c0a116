"""Readings for ROS 2: field by field what diagnostic_msgs defines."""

import math
from dataclasses import replace

import numpy as np
import pytest
from oodd_live import Reading
from rosbags.typesys import Stores, get_typestore

QUIET = Reading(7, 0.5, 1.25, 3.0, False, {}, None, {})
TYPES = get_typestore(Stores.ROS2_HUMBLE).types


def test_exact_shape():
    reading = replace(QUIET, alarm=True, statistic=3.5, sensors={"gyro x": 0.75, "gyro y": 0.25},
                      onset=4, faults={"gyro x": "frozen"})  # fmt: skip
    assert reading.diagnostics("arm watchdog", "arm-1", time=12.75) == {
        "header": {"stamp": {"sec": 12, "nanosec": 750_000_000}, "frame_id": ""},
        "status": [
            {
                "level": b"\x02",
                "name": "arm watchdog",
                "message": "row 7: alarm, gyro x frozen, since row 4",
                "hardware_id": "arm-1",
                "values": [
                    {"key": "row", "value": "7"},
                    {"key": "score", "value": "0.5"},
                    {"key": "statistic", "value": "3.5"},
                    {"key": "threshold", "value": "3.0"},
                    {"key": "alarm", "value": "true"},
                    {"key": "onset", "value": "4"},
                    {"key": "sensor gyro x", "value": "0.750"},
                    {"key": "sensor gyro y", "value": "0.250"},
                    {"key": "fault gyro x", "value": "frozen"},
                ],
            }
        ],
    }


@pytest.mark.parametrize(
    ("changes", "level"),
    [
        ({}, "OK"),
        ({"score": math.nan, "statistic": -math.inf}, "OK"),
        ({"statistic": 3.5}, "WARN"),  # acknowledged
        ({"faults": {"a": "missing"}}, "WARN"),
        ({"alarm": True}, "ERROR"),
        ({"alarm": True, "faults": {"observation": "missing"}}, "STALE"),
        ({"alarm": True, "faults": {"observation": "repeated"}}, "ERROR"),
    ],
)
def test_levels_are_those_of_ros(changes, level):
    (status,) = replace(QUIET, **changes).diagnostics()["status"]
    constant = getattr(TYPES["diagnostic_msgs/msg/DiagnosticStatus"], level)
    assert status["level"] == bytes([constant])


def message(kind, fields):
    """A message of plain fields, which fails for a field too many or too few."""
    return TYPES[kind](**fields)


def test_serialized_as_ros_does():
    array = QUIET.diagnostics(time=1.5e9 + 0.25)
    header = array["header"]
    stamp = message("builtin_interfaces/msg/Time", header["stamp"])
    statuses = [
        message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            status
            | {"level": status["level"][0]}
            | {"values": [message("diagnostic_msgs/msg/KeyValue", v) for v in status["values"]]},
        )
        for status in array["status"]
    ]
    content = message(
        "diagnostic_msgs/msg/DiagnosticArray",
        {"header": message("std_msgs/msg/Header", header | {"stamp": stamp}), "status": statuses},
    )
    store = get_typestore(Stores.ROS2_HUMBLE)
    raw = store.serialize_cdr(content, "diagnostic_msgs/msg/DiagnosticArray")
    back = store.deserialize_cdr(raw, "diagnostic_msgs/msg/DiagnosticArray")
    assert back.header.stamp.sec == 1_500_000_000
    assert back.header.stamp.nanosec == 250_000_000
    assert [v.key for v in back.status[0].values][:2] == ["row", "score"]


def test_no_time_and_numpy_values():
    reading = replace(QUIET, score=np.float64(0.5))
    array = reading.diagnostics()
    assert array["header"]["stamp"] == {"sec": 0, "nanosec": 0}
    assert array["status"][0]["name"] == "oodd"
    assert array["status"][0]["values"][1]["value"] == "0.5"
