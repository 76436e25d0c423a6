"""Force and torque sensors as observations."""

from collections.abc import Sequence
from ctypes import c_double

import numpy as np
import torch
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from torch_panda.bullet import VectorSimulation
from torch_panda.robots import Robot


class Touch:
    """Forces of all environments, read after every step.

    What Bullet computed in the last substep (2 ms) of a step, not an average over it:

    - ``wrist_force_torque`` (6,): force [N] and torque [N m] that the arm exerts on the
      hand, at the robot's ``wrist_joint`` and in the hand's frame (the Panda's z axis
      points from the mount to the fingertips). At rest it bears the weight of the hand
      and of what the hand holds.
    - ``finger_contact`` (n_fingers, 3): sum of the normal and friction forces on each
      finger, whatever it touches, world frame [N].
    - ``joint_torque`` (n_joints,): what the motor of each movable joint exerts [N m],
      of a sliding joint [N].

    All are zero at a reset: no time has passed.

    Args:
        simulation: whose robots feel.
        robot: says where its wrist and its fingers are.
        sensors: which of the three.

    """

    def __init__(
        self, simulation: VectorSimulation, robot: Robot, sensors: Sequence[str]
    ) -> None:
        self._simulation = simulation
        self._robot = robot
        shapes = sensor_shapes(robot)
        self._values = {
            sensor: torch.zeros(
                simulation.num_envs, *shapes[sensor], dtype=torch.float32, device="cpu"
            )
            for sensor in sensors
        }

    def spec(self, batch: torch.Size, device: torch.device) -> dict[str, TensorSpec]:
        """Specs of what is observed."""
        return {
            sensor: Unbounded(
                (*batch, *value.shape[1:]), dtype=torch.float32, device=device
            )
            for sensor, value in self._values.items()
        }

    def after_reset(self, envs: Sequence[int]) -> None:
        """Nothing is felt yet in these environments."""
        for value in self._values.values():
            value[envs] = 0.0

    def after_step(self, envs: Sequence[int]) -> None:
        """Read the sensors of these environments."""
        self._simulation.run(self._read, envs)

    def observe(self) -> dict[str, Tensor]:
        """The latest forces of all environments, float32."""
        return {sensor: value.clone() for sensor, value in self._values.items()}

    def _read(self, env: int) -> None:
        client, scene = self._simulation.clients[env], self._simulation.scene
        rows = {sensor: value[env].numpy() for sensor, value in self._values.items()}
        if "finger_contact" in rows:
            row = rows["finger_contact"]
            row[:] = 0.0
            fingers = self._robot.finger_links
            for contact in client.contact_points(scene.robot):
                if contact.link_a in fingers:
                    row[fingers.index(contact.link_a)] += contact.force_on_a
        if len(rows) == ("finger_contact" in rows):
            return
        forces = client.joint_forces(scene.robot)
        if "wrist_force_torque" in rows:
            assert self._robot.wrist_joint is not None
            wrench = forces.wrench(self._robot.wrist_joint)
            rows["wrist_force_torque"][:] = (c_double * 6).from_address(wrench)
        if "joint_torque" in rows:
            count = max(scene.joints) + 1
            motors = np.array((c_double * count).from_address(forces.motor_forces))
            rows["joint_torque"][:] = motors[list(scene.joints)]


def sensor_shapes(robot: Robot) -> dict[str, tuple[int, ...]]:
    """The sensors that a robot can have, and the shapes of what they tell."""
    shapes: dict[str, tuple[int, ...]] = {}
    if robot.wrist_joint is not None:
        shapes["wrist_force_torque"] = (6,)
    if robot.finger_links:
        shapes["finger_contact"] = (len(robot.finger_links), 3)
    shapes["joint_torque"] = (len(robot.joint_forces),)
    return shapes


def check_sensors(robot: Robot, sensors: Sequence[str]) -> None:
    """Make sure that a robot has these sensors.

    Raises:
        ValueError: it has not.
    """
    available = tuple(sensor_shapes(robot))
    if isinstance(sensors, str) or not set(sensors) <= set(available):
        raise ValueError(
            f"sensors must be among {available} for this robot, got {sensors!r}"
        )
