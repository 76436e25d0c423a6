"""Builds the scene of a robot, a task and sensors."""

from collections.abc import Sequence

from torch_panda.bullet import PhysicsClient, Scene
from torch_panda.robots import Robot
from torch_panda.sensors import Sensor
from torch_panda.tasks import Bodies, Task


class RobotTaskBuilder:
    """Builds the same scene in any client.

    It refers to descriptions only. The simulation refers to the builder. If the builder
    also referred to the simulation, this cycle of references would keep a forgotten
    environment alive.

    Args:
        robot: The robot.
        task: The task.
        sensors: The sensors for which the clients are prepared.
    """

    def __init__(self, robot: Robot, task: Task, sensors: Sequence[Sensor]) -> None:
        self._robot = robot
        self._task = task
        self._sensors = sensors

    def __call__(self, client: PhysicsClient) -> Scene:
        """Build the scene in a client.

        Raises:
            TypeError: `Robot.build` does not return a body id, or `Task.build` does not
                return `Bodies`.
        """
        robot = self._robot
        body = robot.build(client)
        if not isinstance(body, int):
            raise TypeError(
                f"{type(robot).__name__}.build must return the robot's body id, "
                f"got {body!r}"
            )
        bodies = self._build_task(client)
        for sensor in self._sensors:
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

    def _build_task(self, client: PhysicsClient) -> Bodies:
        bodies = self._task.build(client)
        if not isinstance(bodies, Bodies):
            raise TypeError(
                f"{type(self._task).__name__}.build must return Bodies, got {bodies!r}"
            )
        return bodies


def _movable_joints(client: PhysicsClient, body: int) -> tuple[int, ...]:
    return tuple(joint.index for joint in client.joints(body) if joint.is_movable)
