"""Sensors by the keywords of `torch_panda.make`."""

from collections.abc import Sequence

from torch_panda.rendering import Camera
from torch_panda.rendering.camera import resized
from torch_panda.robots import Robot
from torch_panda.sensors.base import Sensor
from torch_panda.sensors.cameras import CameraSensor
from torch_panda.sensors.forces import FORCE_SENSORS, force_sensors_of


def read_keywords(
    *,
    from_pixels: bool = False,
    depth: bool = False,
    segmentation: bool = False,
    camera: Camera | None = None,
    render_size: int | tuple[int, int] | None = None,
    sensors: Sequence[Sensor | str] = (),
) -> Sequence[Sensor | str]:
    """The sensors that some keywords ask for; see `torch_panda.make`.

    Raises:
        ValueError: they contradict each other, or a size is out of range.
    """
    if isinstance(sensors, str):
        return sensors  # which `read_sensors` refuses
    if not (from_pixels or depth or segmentation):
        if camera is not None or render_size is not None:
            raise ValueError(
                "camera and render_size need from_pixels, depth or segmentation"
            )
        return sensors
    view = resized(camera or CameraSensor().camera, render_size)
    pictures = CameraSensor(view, from_pixels, depth, segmentation)
    return (pictures, *sensors)


def read_sensors(sensors: Sequence[Sensor | str], robot: Robot) -> tuple[Sensor, ...]:
    """Sensors, those that were given by name among them, which a robot can have.

    Raises:
        ValueError: the robot cannot have one of them.
        TypeError: one is neither a sensor nor a name.
    """
    known = force_sensors_of(robot)
    named = [sensor for sensor in sensors if isinstance(sensor, str)]
    if isinstance(sensors, str) or not set(named) <= set(known):
        raise ValueError(
            f"sensors must be among {known} for this robot, got {sensors!r}"
        )
    found = tuple(FORCE_SENSORS[s] if isinstance(s, str) else s for s in sensors)
    for sensor in found:
        if not isinstance(sensor, Sensor):
            raise TypeError(f"a sensor must be a Sensor or a name, got {sensor!r}")
        sensor.check(robot)
    return found
