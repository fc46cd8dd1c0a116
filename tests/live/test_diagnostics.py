"""Readings for ROS 2: field by field what diagnostic_msgs defines."""

import json
import math
from dataclasses import replace

import numpy as np
import oodd_live
import pytest
from oodd_live import Reading
from rosbags.typesys import Stores, get_typestore

QUIET = Reading(7, 0.5, 1.25, 3.0, False, {}, None, {})
TYPES = get_typestore(Stores.ROS2_HUMBLE).types


def test_exact_shape():
    reading = replace(QUIET, alarm=True, statistic=3.5, sensors={"gyro x": 0.75, "gyro y": 0.25},
                      onset=4, faults={"gyro x": "frozen"}, parts={"gyro x": 1.0, "fan": 0.25},
                      kind="sensor")  # fmt: skip
    assert reading.diagnostics("arm watchdog", "arm-1", time=12.75) == {
        "header": {"stamp": {"sec": 12, "nanosec": 750_000_000}, "frame_id": ""},
        "status": [
            {
                "level": 2,
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
                    {"key": "kind", "value": "sensor"},
                    {"key": "part gyro x", "value": "1.000"},
                    {"key": "part fan", "value": "0.250"},
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
    assert status["level"] == constant


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, np.float32(0.1)])
def test_json_takes_them_as_they_are(number):
    reading = replace(QUIET, score=number, statistic=number, alarm=True)
    array = reading.diagnostics(time=np.float64(1.5))
    assert json.loads(json.dumps(array, allow_nan=False)) == array
    values = {v["key"]: v["value"] for v in array["status"][0]["values"]}
    finite = repr(float(number)) if math.isfinite(number) else ""
    assert (values["score"], values["statistic"]) == (finite, finite)


def test_serialized_as_ros_does():
    """Messages of plain fields fail for a field too many or too few."""
    array = replace(QUIET, score=np.float64(0.5)).diagnostics(time=1.5e9 + 0.25)
    stamp = TYPES["builtin_interfaces/msg/Time"](**array["header"]["stamp"])
    header = TYPES["std_msgs/msg/Header"](**array["header"] | {"stamp": stamp})
    (status,) = array["status"]
    values = [TYPES["diagnostic_msgs/msg/KeyValue"](**v) for v in status["values"]]
    told = status | {"values": values}
    content = TYPES["diagnostic_msgs/msg/DiagnosticArray"](
        header=header, status=[TYPES["diagnostic_msgs/msg/DiagnosticStatus"](**told)]
    )
    store = get_typestore(Stores.ROS2_HUMBLE)
    raw = store.serialize_cdr(content, "diagnostic_msgs/msg/DiagnosticArray")
    back = store.deserialize_cdr(raw, "diagnostic_msgs/msg/DiagnosticArray")
    assert back.header.stamp.sec == 1_500_000_000
    assert back.header.stamp.nanosec == 250_000_000
    assert [(v.key, v.value) for v in back.status[0].values][:2] == [("row", "7"), ("score", "0.5")]
    assert QUIET.diagnostics()["header"]["stamp"] == {"sec": 0, "nanosec": 0}
    assert QUIET.diagnostics()["status"][0]["name"] == "oodd"


def test_the_evaluator_knows_the_package_by_name():
    from oodd_eval import live

    assert live is oodd_live
