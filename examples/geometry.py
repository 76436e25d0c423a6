"""What an agent may know of the shipped tasks: where things are, and the symmetry.

Transitions that are mirrored or moved over the table are as possible as those that were
seen, nearly: see Invariant Transform Experience Replay (arXiv 1909.10707) for mirrors.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_panda import RobotTaskEnv

# Factors that mirror a quantity in the plane y = 0, in which robot and table are
# symmetric.
_POINT = (1.0, -1.0, 1.0)  # also a velocity
_ANGLES = (-1.0, 1.0, -1.0)  # also an angular velocity
_QUATERNION = (-1.0, 1.0, -1.0, 1.0)


@dataclass(frozen=True)
class Geometry:
    """Of a task, by the layout of its observations and goals.

    Attributes:
        later: indices into (observation, goal), of each object and each goal.
        earlier: of the end-effector for an object, of the object for its goal.
        observation: factors that mirror an observation, (observation size,).
        goal: factors that mirror a goal, (goal size,).
        action: factors that mirror an action; None with joint control.
        positions: where positions begin in an observation.
        goal_positions: where they begin in a goal.
    """

    later: tuple[int, ...]
    earlier: tuple[int, ...]
    observation: tuple[float, ...]
    goal: tuple[float, ...]
    action: tuple[float, ...] | None
    positions: tuple[int, ...]
    goal_positions: tuple[int, ...]

    def mirror(self, batch: TensorDictBase) -> None:
        """Mirror every second row of a batch of transitions."""
        assert self.action is not None
        factors = {
            "observation": self.observation,
            "desired_goal": self.goal,
            "action": self.action,
            ("next", "observation"): self.observation,
            ("next", "desired_goal"): self.goal,
        }
        for key, values in factors.items():
            value = batch[key].clone()
            value[::2] *= value.new_tensor(values)
            batch[key] = value

    def shift(self, batch: TensorDictBase, distance: float) -> None:
        """Move half of the rows of a batch, each by up to ``distance`` in x and y [m].

        Hand, objects and goals move together, as if the robot stood elsewhere.
        """
        rows = slice(len(batch) // 2, None)
        offset = batch["desired_goal"].new_empty(len(batch) - rows.start, 2)
        offset.uniform_(-distance, distance)
        starts = {
            "observation": self.positions,
            "desired_goal": self.goal_positions,
            ("next", "observation"): self.positions,
            ("next", "desired_goal"): self.goal_positions,
        }
        for key, positions in starts.items():
            value = batch[key].clone()
            for start in positions:
                value[rows, start : start + 2] += offset
            batch[key] = value

    def differences(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Objects from the end-effector and goals from objects, (..., n) [m]."""
        inputs = torch.cat((observation, goal), -1)
        return inputs[..., self.later] - inputs[..., self.earlier]


def read_geometry(env: RobotTaskEnv) -> Geometry:
    """The geometry of one of `torch_panda.ENV_IDS`."""
    robot, task = env.robot, env.task
    rotates = task.goal_dim == 4  # Flip: orientations are quaternions
    gripper = (1.0,) * (robot.observation_dim - 6)
    rotation = _QUATERNION if rotates else _ANGLES
    one_object = (*_POINT, *rotation, *_POINT, *_ANGLES)
    num_objects = task.observation_dim // len(one_object)
    size = robot.observation_dim + task.observation_dim

    starts = [robot.observation_dim + len(one_object) * i for i in range(num_objects)]
    goals = () if rotates else tuple(range(0, task.goal_dim, 3))
    # What an object is seen from, and a goal: the hand, and what is to be moved there.
    pairs = [(0, start) for start in starts]
    pairs += [
        (here, size + goal) for here, goal in zip(starts or (0,), goals, strict=False)
    ]
    return Geometry(
        later=tuple(there + axis for _, there in pairs for axis in range(3)),
        earlier=tuple(here + axis for here, _ in pairs for axis in range(3)),
        observation=(*_POINT, *_POINT, *gripper, *one_object * num_objects),
        goal=_QUATERNION if rotates else _POINT * len(goals),
        action=(*_POINT, *gripper) if robot.control_type == "ee" else None,
        positions=(0, *starts),
        goal_positions=goals,
    )
