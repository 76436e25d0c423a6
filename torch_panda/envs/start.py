"""Draws the starts of episodes and holds the tensors of the state."""

import copy
import math
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.bullet.body_state import Doubles
from torch_panda.checks import QUATERNION_TOLERANCE, check_rotations
from torch_panda.envs.randomization import DomainRandomizer
from torch_panda.envs.seeds import EpisodeSeeds
from torch_panda.robots import Robot
from torch_panda.rotations import NO_ROTATION
from torch_panda.tasks import Task
from torch_panda.tasks.base import SAMPLERS

# Number of starts that `check_samplers` draws.
_NUM_PROBES = 100


class EpisodeStarts:
    """Draws the starts of n environments' episodes into the tensors of the state.

    The robot starts in its neutral pose. The task draws the goal, the objects and their
    joints. The randomizer draws the physics, and offsets of the robot's joints.

    Attributes:
        goal: Desired goals of the present episodes, (n, goal_dim) float64.
        step_count: Number of steps of the present episodes, (n, 1) int64.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
        randomizer: DomainRandomizer,
        seeds: EpisodeSeeds,
    ) -> None:
        self._robot, self._task, self._simulation = robot, task, simulation
        self._randomizer = randomizer
        self._seeds = seeds
        self._marker_poses = simulation.marker_pose.numpy()
        n = simulation.num_envs
        self.goal = torch.zeros(n, task.goal_dim, dtype=torch.float64, device="cpu")
        self.step_count = torch.zeros(n, 1, dtype=torch.int64, device="cpu")
        # Arrays of the same memory: indexing a tensor takes three times as long.
        self._arrays = {key: value.numpy() for key, value in self.state().items()}

    def state(self) -> dict[str, Tensor]:
        """The tensors of the state, (n, ...) by key, not copied."""
        simulation = self._simulation
        state = {
            "joint_position": simulation.joint_position,
            "joint_velocity": simulation.joint_velocity,
            "object_pose": simulation.object_pose,
            "object_velocity": simulation.object_velocity,
            "desired_goal": self.goal,
            "step_count": self.step_count,
            **self._randomizer.state,
        }
        if any(simulation.scene.object_joints):
            state["object_joint_position"] = simulation.object_joint_position
            state["object_joint_velocity"] = simulation.object_joint_velocity
        return state

    def draw(self, env: int) -> None:
        """Write the start of an environment's next episode into the state tensors.

        Raises:
            ValueError: The task draws numbers of a wrong shape, numbers that are not
                finite, or quaternions that are not unit quaternions.
        """
        start = self._task.sample_start(self._seeds.next_generator(env))
        row = {key: array[env] for key, array in self._arrays.items()}
        row["step_count"][:] = 0
        _fill(row["desired_goal"], start.goal, self._error_name("sample_goal"))
        row["joint_position"][:] = self._robot.neutral_joint_position
        row["joint_velocity"][:] = 0.0
        if len(row["object_pose"]):
            name = self._error_name("sample_objects")
            _fill(row["object_pose"], start.object_pose, name)
            for *_, x, y, z, w in row["object_pose"].tolist():
                if abs(math.hypot(x, y, z, w) - 1) > QUATERNION_TOLERANCE:
                    raise ValueError(
                        f"{name} must return unit quaternions, got {[x, y, z, w]}"
                    )
            row["object_velocity"][:] = 0.0
        if "object_joint_position" in row:
            joints = row["object_joint_position"]
            drawn = np.asarray(start.object_joint_position)
            # A single number is the position of every joint.
            drawn = np.broadcast_to(drawn, joints.shape) if drawn.size == 1 else drawn
            _fill(joints, drawn, self._error_name("sample_object_joints"))
            row["object_joint_velocity"][:] = 0.0
        if self._randomizer.is_active:
            self._randomizer.draw(env, self._seeds.physics_seed(env))

    def marker_pose(self, goal: Tensor, envs: list[int]) -> Tensor:
        """Poses of the markers for some environments, (len(envs), n_markers, 7).

        Raises:
            ValueError: `Task.marker_pose` returns a quaternion that is not a unit
                quaternion.
        """
        pose = self._task.marker_pose(goal)
        if type(self._task).marker_pose is not Task.marker_pose:
            check_rotations("the marker pose for the desired_goal", pose, envs)
        return pose

    def place_markers(self, envs: list[int]) -> None:
        """Write the poses of the markers into their tensor; see `marker_pose`."""
        if not self._simulation.scene.markers:
            return
        if type(self._task).marker_pose is not Task.marker_pose:
            self._simulation.marker_pose[envs] = self.marker_pose(self.goal[envs], envs)
            return
        # Write the poses of the default `Task.marker_pose` through arrays. This takes a
        # fifth of its time.
        poses, goals = self._marker_poses, self._arrays["desired_goal"]
        for env in envs:
            poses[env, :, :3] = goals[env].reshape(-1, 3)
            poses[env, :, 3:] = NO_ROTATION

    def _error_name(self, name: str) -> str:
        """``sample_start`` if the task overrides it, otherwise ``name``; for errors."""
        if type(self._task).sample_start is not Task.sample_start:
            return "sample_start"
        return name


def check_samplers(task: Task) -> None:
    """Refuse a task that overrides a method which its `sample_start` does not call.

    `sample_start` is called on a copy of the task. If it fails, nothing is refused.

    Raises:
        ValueError: A method is overridden, but never called.
    """
    if type(task).sample_start is Task.sample_start:
        return
    unused = {
        name
        for name in SAMPLERS
        if _override_level(task, name) < _override_level(task, "sample_start")
    }
    if not unused:
        return
    probe = copy.copy(task)

    def record(name: str, rng: np.random.Generator) -> object:
        unused.discard(name)
        return getattr(task, name)(rng)

    for name in unused:
        setattr(probe, name, partial(record, name))
    try:
        # `sample_start` may call a method in some of the episodes only.
        for seed in range(_NUM_PROBES):
            probe.sample_start(np.random.default_rng(seed))
    except Exception:
        return
    if unused:
        owner = type(task).__mro__[_override_level(task, "sample_start")].__name__
        raise ValueError(
            f"{' and '.join(sorted(unused))} of {type(task).__name__} would never be "
            f"called, because {owner}.sample_start draws without "
            f"{'it' if len(unused) == 1 else 'them'}: override sample_start instead"
        )


def _override_level(task: Task, name: str) -> int:
    """Index in the MRO of the class that defines a method; -1 for the object itself."""
    if name in vars(task):
        return -1
    classes = type(task).__mro__
    return next(level for level, base in enumerate(classes) if name in vars(base))


def _fill(row: Doubles, values: object, name: str) -> None:
    """Check the numbers that the task drew and write them into a state tensor's row."""
    drawn = np.asarray(values, dtype=np.float64)
    if drawn.shape != row.shape or not np.isfinite(drawn).all():
        raise ValueError(
            f"{name} must return finite numbers of shape {row.shape}, got {values}"
        )
    row[:] = drawn
