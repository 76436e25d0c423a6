"""Sensors by name, and by the keywords of `torch_panda.make`."""

from collections.abc import Sequence

from torch_panda.arguments import load_class
from torch_panda.checks import check_instance
from torch_panda.rendering import Camera
from torch_panda.rendering.camera import resized
from torch_panda.robots import Robot
from torch_panda.sensors.base import Sensor
from torch_panda.sensors.cameras import CameraSensor

# To add a sensor, add its line here: its name, and its class as `module:Class`.
_CLASSES = {
    "joint_state": "joints:JointState",
    "wrist_force_torque": "forces:WristForceTorque",
    "finger_contact": "forces:FingerContact",
    "joint_torque": "forces:JointTorque",
}
SENSORS: dict[str, Sensor] = {
    name: load_class("torch_panda.sensors", path)() for name, path in _CLASSES.items()
}
"""Sensors that ``make(..., sensors=...)`` accepts by name."""


def sensors_of(robot: Robot) -> tuple[str, ...]:
    """Names of the sensors that a robot can have."""
    names = []
    for name, sensor in SENSORS.items():
        try:
            sensor.check(robot)
        except ValueError:
            continue
        names.append(name)
    return tuple(names)


def read_keywords(
    *,
    from_pixels: bool,
    depth: bool,
    segmentation: bool,
    camera: Camera | None,
    render_size: int | tuple[int, int] | None,
    sensors: Sequence[Sensor | str],
) -> Sequence[Sensor | str]:
    """Turn keywords of `torch_panda.make` into sensors.

    Returns:
        ``sensors``, and a camera sensor before them if the keywords ask for pictures.

    Raises:
        ValueError: The keywords contradict each other, or a size is out of range.
        TypeError: ``sensors`` is no sequence of sensors.
    """
    _check_sequence(sensors)
    if not (from_pixels or depth or segmentation):
        if camera is not None or render_size is not None:
            raise ValueError(
                "camera and render_size need from_pixels, depth or segmentation"
            )
        return sensors
    view = resized(camera or CameraSensor().camera, render_size)
    pictures = CameraSensor(view, from_pixels, depth, segmentation)
    return (pictures, *sensors)


def resolve_sensors(
    sensors: Sequence[Sensor | str], robot: Robot
) -> tuple[Sensor, ...]:
    """Look up sensors that are given by name, and check that the robot can have them.

    Raises:
        ValueError: A name is unknown, or the robot cannot have a sensor.
        TypeError: An argument has a wrong type.
    """
    _check_sequence(sensors)
    for sensor in sensors:
        if not isinstance(sensor, str):
            check_instance("each of sensors", sensor, Sensor)
        elif sensor not in sensors_of(robot):
            raise ValueError(
                f"sensors must be among {sensors_of(robot)} for this robot, or Sensor "
                f"objects, got {sensor!r}"
            )
    read = [SENSORS[item] if isinstance(item, str) else item for item in sensors]
    for sensor in read:
        sensor.check(robot)
    return tuple(read)


def _check_sequence(sensors: object) -> None:
    """Check that an argument is a sequence; a text is one name, not a sequence."""
    if isinstance(sensors, str) or not isinstance(sensors, Sequence):
        raise TypeError(
            f"sensors must be a tuple or list of names or Sensor objects, got "
            f"{sensors!r}"
        )
