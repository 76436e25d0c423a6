"""Force sensors.

They report the values of the last substep of a step, not averages over the step. After
a reset all values are zero, because no time has passed. After a reset to an exact
state, which repeats the steps up to this state, they are the values of its last step.
"""

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, Scene, VectorSimulation
from torch_panda.rendering import VectorRenderer
from torch_panda.robots import Robot
from torch_panda.sensors.base import Entry, Reading, Sensor


class ForceSensor(Sensor):
    """A sensor with one entry, which is read in each client after each step.

    Attributes:
        name: Key of the entry.
    """

    name: str

    @abstractmethod
    def shape(self, robot: Robot) -> tuple[int, ...] | None:
        """Shape of the entry, or None if the robot cannot have the sensor."""

    @abstractmethod
    def read(
        self, client: PhysicsClient, scene: Scene, robot: Robot
    ) -> npt.NDArray[np.float64]:
        """Read the sensor in one client.

        Returns:
            An array of `shape`, which is observed as float32.
        """

    def check(self, robot: Robot) -> None:
        """Refuse a robot that cannot have the sensor; see `Sensor.check`."""
        if self.shape(robot) is None:
            raise ValueError(
                f"{type(robot).__name__} cannot have the sensor {self.name!r}; see "
                f"{type(self).__name__} for what it needs"
            )

    def attach(
        self, simulation: VectorSimulation, renderer: VectorRenderer, robot: Robot
    ) -> Reading:
        """Read the sensor in all environments."""
        return _ForceReading(self, simulation, robot)


class WristForceTorque(ForceSensor):
    """Force [N] and torque [N m] that the arm exerts on the hand: (6,).

    They act at the robot's ``wrist_joint`` and are given in the hand's frame. The z
    axis of the Panda's hand points from the mount to the fingertips. At rest the wrist
    bears the weight of the hand and of the object in it.

    The robot needs a ``wrist_joint``.
    """

    name = "wrist_force_torque"

    def shape(self, robot: Robot) -> tuple[int, ...] | None:
        """(6,), or None without a ``wrist_joint``."""
        return None if robot.wrist_joint is None else (6,)

    def build(self, client: PhysicsClient, body: int, robot: Robot) -> None:
        """Let Bullet compute the forces through the wrist."""
        assert robot.wrist_joint is not None  # `check` has refused such a robot.
        client.enable_wrench_sensor(body, robot.wrist_joint)

    def read(
        self, client: PhysicsClient, scene: Scene, robot: Robot
    ) -> npt.NDArray[np.float64]:
        """Force and torque of the last substep: (6,)."""
        return client.state(scene.robot).wrenches[robot.wrist_joint]


class FingerContact(ForceSensor):
    """Contact force on each finger: (n_fingers, 3), world frame [N].

    It is the sum of normal and friction forces over all contacts of the finger.

    The robot needs ``finger_links``.
    """

    name = "finger_contact"

    def shape(self, robot: Robot) -> tuple[int, ...] | None:
        """(n_fingers, 3), or None without ``finger_links``."""
        return (len(robot.finger_links), 3) if robot.finger_links else None

    def read(
        self, client: PhysicsClient, scene: Scene, robot: Robot
    ) -> npt.NDArray[np.float64]:
        """Contact forces of the last substep: (n_fingers, 3)."""
        fingers = robot.finger_links
        forces = np.zeros((len(fingers), 3))
        for contact in client.contact_points(scene.robot):
            if contact.link_a in fingers:
                forces[fingers.index(contact.link_a)] += contact.force_on_a
        return forces


class JointTorque(ForceSensor):
    """Torque [N m] of the motor of each movable joint, or force [N] of a sliding one.

    A robot with the control type "joint_torque" cannot have this sensor: Bullet reports
    the torques of its motors, but not the torques that such actions apply.
    """

    name = "joint_torque"

    def shape(self, robot: Robot) -> tuple[int, ...] | None:
        """(n_joints,), or None under the control type "joint_torque"."""
        is_torque = robot.control_type == "joint_torque"
        return None if is_torque else (len(robot.effort_limits),)

    def read(
        self, client: PhysicsClient, scene: Scene, robot: Robot
    ) -> npt.NDArray[np.float64]:
        """Torques of the last substep: (n_joints,)."""
        return client.state(scene.robot).motor_forces[list(scene.joints)]


class _ForceReading:
    """The latest values of a force sensor in all environments."""

    def __init__(
        self, sensor: ForceSensor, simulation: VectorSimulation, robot: Robot
    ) -> None:
        self._sensor = sensor
        self._simulation = simulation
        self._robot = robot
        shape = sensor.shape(robot)
        assert shape is not None  # `check` has refused such a robot.
        self.entries = {sensor.name: Entry(shape, torch.float32)}
        self._values = torch.zeros(simulation.num_envs, *shape, device="cpu").float()

    def after_reset(self, envs: Sequence[int]) -> None:
        self._values[envs] = 0.0

    def after_step(self, envs: Sequence[int]) -> None:
        self._simulation.run(self._read, envs)

    def observe(self) -> dict[str, Tensor]:
        return {self._sensor.name: self._values.clone()}

    def _read(self, env: int) -> None:
        client, scene = self._simulation.clients[env], self._simulation.scene
        value = self._sensor.read(client, scene, self._robot)
        row = self._values[env].numpy()
        if np.shape(value) != row.shape:
            raise ValueError(
                f"{type(self._sensor).__name__}.read must return shape {row.shape}, "
                f"got {np.shape(value)}"
            )
        row[:] = value
