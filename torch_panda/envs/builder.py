"""Builds the scene of a robot, a task and sensors."""

from collections.abc import Sequence

from torch_panda.bullet import PhysicsClient, Scene
from torch_panda.robots import Robot
from torch_panda.sensors import Sensor
from torch_panda.tasks import Bodies, Task


def build_scene(
    robot: Robot, task: Task, sensors: Sequence[Sensor], client: PhysicsClient
) -> Scene:
    """Build the scene in a client. It is the same scene in every client.

    Raises:
        TypeError: `Robot.build` does not return a body id, or `Task.build` does not
            return `Bodies`.
    """
    body = robot.build(client)
    if not isinstance(body, int):
        raise TypeError(
            f"{type(robot).__name__}.build must return the robot's body id, "
            f"got {body!r}"
        )
    bodies = task.build(client)
    if not isinstance(bodies, Bodies):
        raise TypeError(
            f"{type(task).__name__}.build must return Bodies, got {bodies!r}"
        )
    for sensor in sensors:
        sensor.build(client, body, robot)
    objects = tuple(bodies.objects)
    return Scene(
        robot=body,
        joints=_movable_joints(client, body),
        ee_link=robot.ee_link,
        objects=objects,
        object_joints=tuple(_movable_joints(client, k) for k in objects),
        markers=tuple(bodies.markers),
    )


def _movable_joints(client: PhysicsClient, body: int) -> tuple[int, ...]:
    return tuple(joint.number for joint in client.joints(body) if joint.is_movable)
