"""Sensors: observations in addition to the state of robot and task."""

from torch_panda.sensors.base import Entry, Observer, Reading, Sensor, join_entries
from torch_panda.sensors.cameras import CameraSensor
from torch_panda.sensors.forces import (
    FingerContact,
    ForceSensor,
    JointTorque,
    WristForceTorque,
)
from torch_panda.sensors.joints import JointState
from torch_panda.sensors.keywords import SENSORS, read_keywords, resolve_sensors

__all__ = [
    "SENSORS",
    "CameraSensor",
    "Entry",
    "FingerContact",
    "ForceSensor",
    "JointState",
    "JointTorque",
    "Observer",
    "Reading",
    "Sensor",
    "WristForceTorque",
    "join_entries",
    "read_keywords",
    "resolve_sensors",
]
