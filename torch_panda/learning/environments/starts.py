"""Training episodes that start in the middle of their task.

Hindsight goals teach nothing about an object until something moves it. The authors of
HER started half of the episodes of pick-and-place with the box in the hand (arXiv
1707.01495, section 4.1). Lanier et al. started with some blocks stacked (arXiv
1906.03710). Here a scripted hand makes such states before the training, and `StartFrom`
starts some training episodes in them.
"""

from math import pi
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Transform

from torch_panda.experts.moves import carry, go_over, is_held, norm
from torch_panda.learning.environments.geometry import read_geometry
from torch_panda.registry import make
from torch_panda.rotations import NO_ROTATION
from torch_panda.tasks import Flip, Push, Slide, Stack

SCRIPT_STEPS = 45  # steps in which the scripted hand reaches its position
# Range of the distance between the centres of hand and object, if a hand with a blocked
# gripper stops beside the object [m]. The fingers are at most 2.3 cm long and wide, so
# they do not touch the object.
GAP = (0.055, 0.08)
# Height of an object that is held up above the others [m].
LIFTED = (0.12, 0.2)
ROOM = 0.08  # smallest distance between the centres of two objects [m]
OPEN_HAND = (0.0, 0.0, 0.0, 1.0)  # action of a hand that waits with open fingers
PLACED_KEYS = ["joint_position", "joint_velocity", "object_pose", "object_velocity"]


def states_at_objects(
    env_id: str,
    *,
    seed: int,
    number: int = 32,
    **env_options: Any,  # noqa: ANN401 (options of `make`)
) -> TensorDict:
    """Make states in which the hand is at an object.

    A hand with a blocked gripper stops beside the object. A hand with a free gripper
    holds the object. With two objects (Stack) there are four situations, which are
    equally frequent:

    - The hand holds the first object.
    - The hand holds the last object.
    - The hand holds the last object up. ``first_to_goal`` is true.
    - The hand waits above the objects. ``first_to_goal`` is true.

    Where ``first_to_goal`` is true, `StartFrom` moves the first object to the goal of
    the episode, so that the last object remains to be placed.

    Args:
        env_id: Id of the environment.
        seed: Seed of the objects' positions and of the side on which the hand stops.
        number: Number of attempts.
        **env_options: Other arguments of `torch_panda.make`.

    Returns:
        States (n,) with the entries `PLACED_KEYS` of `RobotTaskEnv.get_state` and
        ``first_to_goal``, (n, 1) bool. Failed attempts are left out, so n is at most
        ``number``.

    Raises:
        ValueError: The task is not Push, PickAndPlace, Slide, Stack or Flip, the robot
            is not under end-effector control, or all attempts failed.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(number, 1, generator=generator)

    with (
        make(env_id, num_envs=number, seed=seed, **env_options) as env,
        torch.no_grad(),
    ):
        geometry = read_geometry(env)
        has_objects = isinstance(env.task, Push | Slide | Stack | Flip)
        if geometry is None or geometry.action is None or not has_objects:
            raise ValueError(
                "start_at_object needs end-effector control and one of the tasks Push, "
                f"PickAndPlace, Slide, Stack and Flip, got {env_id}: pass "
                "--start-at-object 0"
            )
        # The first column of each position in an observation: of the hand (not needed
        # here), then of each object.
        _, *columns = geometry.positions
        last = columns[-1]
        # For each situation, the column of the object to which the hand moves.
        targets = [*columns, last, last] if len(columns) > 1 else columns
        situation = (torch.arange(number) % len(targets)).unsqueeze(1)
        target_columns = torch.tensor(targets)[situation] + torch.arange(3)
        first_to_goal = situation >= len(columns)
        waits = situation > len(columns)
        angle, gap, lift = uniform(0, 2 * pi), uniform(*GAP), uniform(*LIFTED)
        beside = gap * torch.cat((angle.cos(), angle.sin(), 0 * angle), -1)
        has_blocked_gripper = env.action_spec_unbatched.shape[-1] == 3
        td = env.reset()
        for _ in range(SCRIPT_STEPS):
            observation = td["observation"]
            hand, width = observation[:, :3], observation[:, 6:7]
            target = observation.gather(1, target_columns)
            if has_blocked_gripper:
                # A slow hand does not push the object.
                action = go_over(hand, target + beside, clearance=0.1, limit=0.6)
                arrived = norm(target + beside - hand) < 0.01
            else:
                height = torch.where(first_to_goal, lift, target[:, 2:])
                point = torch.cat((target[:, :2], height), 1)
                action = carry(hand, width, target, point)
                arrived = is_held(hand, width, target) & (norm(point - target) < 0.02)
                arrived = arrived | waits
                action = torch.where(waits, torch.tensor(OPEN_HAND), action)
            td = env.step(td.set("action", action))["next"]  # type: ignore[assignment]
        state = env.get_state().select(*PLACED_KEYS).set("first_to_goal", first_to_goal)
    speed = state["object_velocity"].abs().flatten(1).amax(1, keepdim=True)
    succeeded = (arrived & (speed < 0.1)).squeeze(1)
    if not succeeded.any():
        raise ValueError(
            f"start_at_object found no start, because in {SCRIPT_STEPS} steps the hand "
            f"of {env_id} reaches no object: let it move faster, or pass "
            "--start-at-object 0"
        )
    return state[succeeded]


class StartFrom(Transform):
    """Starts some episodes in given states, and keeps each episode's goal.

    Args:
        states: States (n,) of `states_at_objects`.
        ratio: Fraction of the episodes that start in these states. torch's global
            generator chooses the episodes.
    """

    def __init__(self, states: TensorDict, ratio: float) -> None:
        super().__init__()
        self.states = states
        self.ratio = ratio

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        assert self.parent is not None
        env = self.parent.base_env
        is_chosen = torch.rand(*env.batch_size, 1) < self.ratio
        requested = tensordict.get("_reset", None)
        if requested is not None:
            is_chosen &= requested.cpu()
        if not is_chosen.any():
            return tensordict_reset
        indices = torch.randint(len(self.states), env.batch_size)
        state: TensorDict
        state = self.states[indices].clone()  # type: ignore[assignment]  # a TensorDict
        first_to_goal: torch.Tensor = state.pop("first_to_goal")
        first_to_goal = first_to_goal.squeeze(-1)
        if first_to_goal.any():
            goal = tensordict_reset["desired_goal"].to(state["object_pose"])
            rotation = goal.new_tensor(NO_ROTATION).expand(len(goal), 4)
            pose_at_goal = torch.cat((goal[:, :3], rotation), 1)
            # If the last object is in the way, the episode starts as usual.
            to_last = (pose_at_goal - state["object_pose"][:, -1])[:, :3]
            has_room = to_last.norm(dim=1) > ROOM
            is_chosen &= (has_room | ~first_to_goal).unsqueeze(-1)
            if not is_chosen.any():
                return tensordict_reset
            state["object_pose"][first_to_goal, 0] = pose_at_goal[first_to_goal]
            state["object_velocity"][first_to_goal, 0] = 0.0
        # Reset the chosen environments again, to these states. The others keep the
        # observations of the first reset.
        start = tensordict_reset.copy().update(state.to(env.device))
        start = env.reset(start.set("_reset", is_chosen.to(env.device)), set_state=True)
        return start.select(*tensordict_reset.keys(True, True))
