"""Exploration by moving the arm towards random points.

With a new random action in every step, the hand hardly leaves its place. If it repeats
one random action for many steps, it drifts away from the table. Here the hand moves to
a random point, and then to the next point. Half of the points are near an object, so
that the hand pushes it on its way. If all actions explore, the cube of Push moves in
79 % of the episodes. It moves in 53 % if all points are anywhere over the table, and in
23 % if the actions are random.
"""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import AdditiveGaussianModule, EGreedyModule

from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.environments.spaces import Spaces

# Two corners of the box from which points are drawn, in the world frame [m]. The box is
# around the origin, where the objects start.
BOX = (-0.2, -0.2, 0.0), (0.2, 0.2, 0.08)
# Half of the points are near an object: at most OBJECT_DISTANCE from its centre along x
# and along y, and up to the heights in OBJECT_HEIGHTS below and above its centre [m].
NEAR_OBJECTS = 0.5
OBJECT_DISTANCE = 0.1
OBJECT_HEIGHTS = (-0.02, 0.06)
# If there are objects, each environment always moves to points in its first WARM_UP
# steps, so that the replay buffer soon has many contacts. During training, torchrl's
# collector uses up one of these steps when it is made.
WARM_UP = 250
JOINT_RANGE = 0.5  # largest displacement of each joint under joint control [rad]
DURATION = (4, 12)  # fewest and most steps towards one point
NOISE = 0.2  # standard deviation of the Gaussian noise on actions towards a point


def make_noise(spaces: Spaces, hp: Hyperparameters) -> list[TensorDictModuleBase]:
    """Make the exploration of a deterministic actor: noise and random actions."""
    action_spec = spaces.action_spec(spaces.num_envs)
    noise = AdditiveGaussianModule(
        action_spec, sigma_init=hp.noise_eps, sigma_end=hp.noise_eps
    )
    if hp.exploration == "points":
        return [noise, RandomPointModule(spaces, hp)]
    random_action = EGreedyModule(action_spec)
    # A probability for each environment, (num_envs,).
    random_action.eps = torch.linspace(*hp.random_eps, spaces.num_envs)
    return [noise, random_action]


class RandomPointModule(TensorDictModuleBase):
    """Replaces some actions by actions that move the arm to a random point.

    In each step, an environment without a point draws one with a certain probability,
    and keeps it for several steps. In the first `WARM_UP` steps, every environment
    always moves to points. The gripper's action is drawn uniformly together with the
    point. Under joint control, a point is the remaining displacement of all joints.

    Like torchrl's exploration modules, this module acts under
    ``ExplorationType.RANDOM`` or None, and draws from torch's global random generator.
    Its state is part of ``state_dict``.

    Args:
        spaces: Sizes and layout of observations and actions. If the layout has no
            objects, all points are anywhere in the box.
        hp: Hyperparameters. After the warm-up, `random_eps` is the fraction of the
            steps in which the first and the last environment move to points.
    """

    steps_left: Tensor
    point: Tensor
    gripper: Tensor
    start_probability: Tensor
    warm_up_left: Tensor
    position_columns: Tensor

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__()
        self.in_keys = ["observation", "action"]
        self.out_keys = ["action"]  # type: ignore[misc]  # it has a setter
        num_envs, geometry = spaces.num_envs, spaces.geometry
        hand_column, *object_columns = (geometry and geometry.positions) or (0,)
        eps = torch.linspace(*hp.random_eps, num_envs)
        # A move lasts d steps on average. If it starts with probability p per step, the
        # pause before it lasts (1 - p) / p steps. Choose p so that d / (d + pause) is
        # eps.
        mean_duration = sum(DURATION) / 2
        self.register_buffer(
            "start_probability", eps / (eps + mean_duration * (1 - eps))
        )
        self.action_scale = spaces.action_scale
        self.moves_joints = spaces.moves_joints
        self.hand = slice(hand_column, hand_column + 3)
        self.box = geometry.box if geometry and geometry.box else BOX
        self.num_objects = len(object_columns)
        # Columns of the three coordinates of each object, (num_objects, 3).
        x_columns = torch.tensor(object_columns, dtype=torch.int64).unsqueeze(-1)
        self.register_buffer(
            "position_columns", x_columns + torch.arange(3), persistent=False
        )
        # Without objects there are no contacts to collect.
        warm_up = WARM_UP if self.num_objects else 0
        self.register_buffer("warm_up_left", torch.tensor(warm_up))
        self.register_buffer("steps_left", torch.zeros(num_envs, dtype=torch.int64))
        self.register_buffer("point", torch.zeros(num_envs, spaces.num_arm_actions))
        gripper_size = spaces.action_size - spaces.num_arm_actions
        self.register_buffer("gripper", torch.zeros(num_envs, gripper_size))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replace the actions of the environments that move to a point."""
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return tensordict
        self._start_moves(tensordict["observation"])
        arm = self._move(tensordict["observation"])
        action = torch.cat((arm, self.gripper), dim=-1)
        action = (action + NOISE * torch.randn_like(action)).clamp(-1.0, 1.0)
        moves = (self.steps_left > 0).unsqueeze(-1)
        self.steps_left.sub_(1).clamp_(min=0)
        return tensordict.set(
            "action", torch.where(moves, action, tensordict["action"])
        )

    def _start_moves(self, observation: Tensor) -> None:
        """Draw which environments without a point get one, and draw the points."""
        draws = torch.rand_like(self.start_probability)
        is_warm_up = self.warm_up_left > 0
        self.warm_up_left.sub_(1).clamp_(min=0)
        draws_point = is_warm_up | (draws < self.start_probability)
        starts = (self.steps_left == 0) & draws_point
        shortest, longest = DURATION
        durations = torch.randint_like(self.steps_left, shortest, longest + 1)
        self.steps_left.copy_(torch.where(starts, durations, self.steps_left))
        if self.moves_joints:
            point = JOINT_RANGE * (2 * torch.rand_like(self.point) - 1)
        else:
            point = self._draw_points(observation)
        gripper = 2 * torch.rand_like(self.gripper) - 1
        self.point.copy_(torch.where(starts.unsqueeze(-1), point, self.point))
        self.gripper.copy_(torch.where(starts.unsqueeze(-1), gripper, self.gripper))

    def _draw_points(self, observation: Tensor) -> Tensor:
        """Draw a point for the hand in each environment, (num_envs, 3) [m]."""
        low, high = map(self.point.new_tensor, self.box)
        point = low + (high - low) * torch.rand_like(self.point)
        if not self.num_objects:
            return point
        choice = torch.randint(self.num_objects, (len(point),), device=point.device)
        centre = observation.gather(-1, self.position_columns[choice])
        lowest, highest = OBJECT_HEIGHTS
        low = point.new_tensor((-OBJECT_DISTANCE, -OBJECT_DISTANCE, lowest))
        high = point.new_tensor((OBJECT_DISTANCE, OBJECT_DISTANCE, highest))
        near = centre + low + (high - low) * torch.rand_like(point)
        near[:, 2].clamp_(min=self.box[0][2])  # not below the table
        is_near = torch.rand_like(point[:, :1]) < NEAR_OBJECTS
        return torch.where(is_near, near, point)

    def _move(self, observation: Tensor) -> Tensor:
        """Return the arm's actions towards the points, before noise and clipping."""
        if not self.moves_joints:
            return (self.point - observation[..., self.hand]) / self.action_scale
        # The positions of the joints are not observed. So `point` holds the remaining
        # displacement, and each action reduces it.
        action = (self.point / self.action_scale).clamp(-1.0, 1.0)
        moves = (self.steps_left > 0).unsqueeze(-1)
        self.point.sub_(torch.where(moves, self.action_scale * action, 0.0))
        return action
