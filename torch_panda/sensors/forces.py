"""Force sensors.

They read what Bullet computed in the last substep (2 ms) of a step, not an average over
it. All are zero at a reset: no time has passed.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, Scene, VectorSimulation
from torch_panda.rendering import VectorRenderer
from torch_panda.robots import Robot
from torch_panda.sensors.base import Entry, Reading, Sensor


class ForceSensor(Sensor):
    """A sensor that a robot has or has not, observed under its own name.

    Attributes:
        name: of the entry, (*shape) float32.
    """

    name: str

    @abstractmethod
    def shape(self, robot: Robot) -> tuple[int, ...] | None:
        """Shape of what it reads; None: the robot cannot have it."""

    @abstractmethod
    def read(
        self, client: PhysicsClient, scene: Scene, robot: Robot
    ) -> npt.NDArray[np.float64]:
        """What it reads in a client, in that shape."""

    def check(self, robot: Robot) -> None:
        """Make sure that a robot has this sensor; see `Sensor.check`."""
        if self.shape(robot) is None:
            raise ValueError(
                f"sensors must be among {force_sensors_of(robot)} for this robot, got "
                f"{self.name!r}"
            )

    def attach(
        self, simulation: VectorSimulation, renderer: VectorRenderer, robot: Robot
    ) -> Reading:
        """Feel in all environments of a simulation."""
        return _Forces(self, simulation, robot)


@dataclass(frozen=True)
class WristForceTorque(ForceSensor):
    """Force [N] and torque [N m] that the arm exerts on the hand: (6,).

    At the robot's ``wrist_joint`` and in the hand's frame (the Panda's z axis points
    from the mount to the fingertips). At rest it bears the weight of the hand and of
    what the hand holds.
    """

    name = "wrist_force_torque"

    def shape(self, robot: Robot) -> tuple[int, ...] | None:
        """(6,)."""
        return None if robot.wrist_joint is None else (6,)

    def build(self, client: PhysicsClient, body: int, robot: Robot) -> None:
        """Have the forces through the wrist computed."""
        assert robot.wrist_joint is not None  # checked before
        client.enable_wrench_sensor(body, robot.wrist_joint)

    def read(
        self, client: PhysicsClient, scene: Scene, robot: Robot
    ) -> npt.NDArray[np.float64]:
        """Of the last substep: (6,)."""
        return client.state(scene.robot).wrenches[robot.wrist_joint]


@dataclass(frozen=True)
class FingerContact(ForceSensor):
    """Sum of normal and friction forces on each finger, world frame [N]: (fingers, 3).

    Whatever the finger touches.
    """

    name = "finger_contact"

    def shape(self, robot: Robot) -> tuple[int, ...] | None:
        """(n_fingers, 3)."""
        return (len(robot.finger_links), 3) if robot.finger_links else None

    def read(
        self, client: PhysicsClient, scene: Scene, robot: Robot
    ) -> npt.NDArray[np.float64]:
        """Of the last substep: (n_fingers, 3)."""
        fingers = robot.finger_links
        forces = np.zeros((len(fingers), 3))
        for contact in client.contact_points(scene.robot):
            if contact.link_a in fingers:
                forces[fingers.index(contact.link_a)] += contact.force_on_a
        return forces


@dataclass(frozen=True)
class JointTorque(ForceSensor):
    """What the motor of each movable joint exerts [N m], of a sliding one [N].

    Not for a robot of the control type "joint_torque": Bullet reports what its motors
    exert, not the torques that actions apply.
    """

    name = "joint_torque"

    def shape(self, robot: Robot) -> tuple[int, ...] | None:
        """(n_joints,)."""
        is_torque = robot.control_type == "joint_torque"
        return None if is_torque else (len(robot.joint_forces),)

    def read(
        self, client: PhysicsClient, scene: Scene, robot: Robot
    ) -> npt.NDArray[np.float64]:
        """Of the last substep: (n_joints,)."""
        return client.state(scene.robot).motor_forces[list(scene.joints)]


FORCE_SENSORS: dict[str, ForceSensor] = {
    sensor.name: sensor
    for sensor in (WristForceTorque(), FingerContact(), JointTorque())
}


def force_sensors_of(robot: Robot) -> tuple[str, ...]:
    """Names of the force sensors that a robot can have."""
    return tuple(name for name, sensor in FORCE_SENSORS.items() if sensor.shape(robot))


class _Forces:
    """The latest forces of all environments."""

    def __init__(
        self, sensor: ForceSensor, simulation: VectorSimulation, robot: Robot
    ) -> None:
        self._sensor = sensor
        self._simulation = simulation
        self._robot = robot
        shape = sensor.shape(robot)
        assert shape is not None  # checked before
        self.entries = {sensor.name: Entry(shape, torch.float32)}
        self._values = torch.zeros(simulation.num_envs, *shape, device="cpu").float()

    def after_reset(self, envs: Sequence[int]) -> None:
        """Nothing is felt yet in these environments."""
        self._values[envs] = 0.0

    def after_step(self, envs: Sequence[int]) -> None:
        """Read the sensors of these environments."""
        self._simulation.run(self._read, envs)

    def observe(self) -> dict[str, Tensor]:
        """The latest forces of all environments, float32."""
        return {self._sensor.name: self._values.clone()}

    def _read(self, env: int) -> None:
        client, scene = self._simulation.clients[env], self._simulation.scene
        value = self._sensor.read(client, scene, self._robot)
        self._values[env].numpy()[:] = value
