"""Sensors: each is an object that an environment is given."""

from torch_panda.sensors.base import Entry, Observer, Reading, Sensor, join_entries
from torch_panda.sensors.cameras import CameraSensor
from torch_panda.sensors.forces import (
    FORCE_SENSORS,
    FingerContact,
    ForceSensor,
    JointTorque,
    WristForceTorque,
)
from torch_panda.sensors.keywords import read_keywords, read_sensors

__all__ = [
    "FORCE_SENSORS",
    "CameraSensor",
    "Entry",
    "FingerContact",
    "ForceSensor",
    "JointTorque",
    "Observer",
    "Reading",
    "Sensor",
    "WristForceTorque",
    "join_entries",
    "read_keywords",
    "read_sensors",
]
