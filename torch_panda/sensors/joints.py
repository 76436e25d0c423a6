"""The sensor "joint_state": positions and velocities of the robot's joints."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.rendering import VectorRenderer
from torch_panda.robots import Robot
from torch_panda.sensors.base import Entry, Reading, Sensor


class JointState(Sensor):
    """Positions and velocities of all movable joints of the robot.

    It observes ``joint_position`` [rad] and ``joint_velocity`` [rad/s], (n_joints,)
    float32 each. The values of sliding joints, such as the Panda's fingers, are in [m]
    and [m/s].
    """

    def attach(
        self, simulation: VectorSimulation, renderer: VectorRenderer, robot: Robot
    ) -> Reading:
        """Read the joints of all environments."""
        return _JointReading(simulation)


class _JointReading:
    """The joints of all environments, which the simulation already has in tensors."""

    def __init__(self, simulation: VectorSimulation) -> None:
        self._simulation = simulation
        entry = Entry((simulation.joint_position.shape[1],), torch.float32)
        self.entries = {"joint_position": entry, "joint_velocity": entry}

    def after_reset(self, envs: Sequence[int]) -> None:
        """Do nothing: the simulation has read the joints."""

    after_step = after_reset

    def observe(self) -> dict[str, Tensor]:
        return {
            "joint_position": self._simulation.joint_position.float(),
            "joint_velocity": self._simulation.joint_velocity.float(),
        }
