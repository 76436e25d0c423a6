"""Computes the setpoints of a robot in C."""

import numpy as np
from torch import Tensor

from torch_panda.bullet import VectorSimulation, native
from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.connection import doubles
from torch_panda.robots.base import Robot
from torch_panda.robots.gripper import Gripper


class CompiledSetpoints:
    """Computes the same numbers as `Robot.setpoint`, in less time.

    Args:
        robot: A robot for which `applies` is true.
        simulation: The environments.
    """

    def __init__(self, robot: Robot, simulation: VectorSimulation) -> None:
        assert native.LIBRARY is not None
        self._robot, self._library = robot, native.LIBRARY
        self._state = simulation.state.rows
        arm, is_ee = robot.num_arm_joints, robot.control_type == "ee"
        # A setpoint has the position of the hand, or of the arm's joints (the first
        # columns of the state), displaced by the scaled action. The positions of the
        # other joints follow. They are neutral, unless the action moves the fingers.
        num_displaced = 3 if is_ee else arm
        resting = () if robot.has_free_gripper else robot.neutral_joint_position[arm:]
        self._actuation = native.Actuation(
            row_size=self._state.shape[1],
            column=simulation.state.ee_column if is_ee else 0,
            num_displaced=num_displaced,
            has_limits=is_ee,
            num_resting=len(resting),
            has_gripper=robot.has_free_gripper,
            resting=doubles(resting),
        )
        if is_ee:
            self._actuation.lowest[:], self._actuation.highest[:] = robot.workspace
        num_fingers = 0
        if robot.gripper is not None and robot.has_free_gripper:
            self._actuation.gripper = robot.gripper.describe(arm)
            num_fingers = robot.gripper.num_joints
        size = num_displaced + len(resting) + num_fingers
        self._setpoint = np.empty((simulation.num_envs, size))
        self._state_address = self._state.data_ptr()
        self._setpoint_address = self._setpoint.ctypes.data

    @staticmethod
    def applies(robot: Robot, simulation: VectorSimulation) -> bool:
        """Whether C can compute the setpoints of this robot."""
        robot_class = type(robot)
        return (
            simulation.is_native
            and robot_class.setpoint is Robot.setpoint
            and robot_class.arm_setpoint is Robot.arm_setpoint
            and robot.control_type in ("ee", "joints")
            and (not robot.has_free_gripper or has_compiled_width(robot))
        )

    def __call__(self, action: Tensor) -> Doubles:
        """Setpoints for actions.

        Args:
            action: Clipped actions, (num_envs, action_dim) float32.

        Returns:
            (num_envs, k) float64, which the next call overwrites.
        """
        self._actuation.scale = self._robot.action_scale
        self._library.environment_setpoints(
            self._actuation,
            self._state_address,
            len(self._setpoint),
            action.contiguous().data_ptr(),
            self._setpoint_address,
        )
        return self._setpoint


def has_compiled_width(robot: Robot) -> bool:
    """Whether C can compute the distance between the fingers of a free gripper."""
    gripper = robot.gripper
    # The width is a weighted sum of the positions of the fingers' joints. For more than
    # two joints, the order in which torch adds is unknown. The C code does not support
    # ``followers``.
    return (
        type(gripper) is Gripper and gripper.num_joints == 2 and not gripper.followers
    )
