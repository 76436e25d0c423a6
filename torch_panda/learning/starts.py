"""Training episodes that start in the middle of their task.

Hindsight goals teach nothing about an object until something moves it. The authors of
HER started half of the episodes of pick-and-place with the box in the hand (arXiv
1707.01495, section 4.1). Lanier et al. started with some blocks stacked (arXiv
1906.03710). Here a scripted hand makes such states.
"""

from math import pi

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Transform

from torch_panda.experts.moves import carry, go_over, is_held, norm
from torch_panda.learning.geometry import read_geometry
from torch_panda.registry import make
from torch_panda.tasks import Flip, Push, Slide, Stack

APPROACH = 45  # steps that the scripted hand takes
# Distance at which a hand with a blocked gripper stops beside an object, between the
# centres [m]. The fingers, at most 2.3 cm long and wide, do not touch it then.
GAP = (0.055, 0.08)
# Height at which the hand holds the last of several objects above the first [m].
LIFTED = (0.12, 0.2)
ROOM = 0.08  # smallest distance between the centres of two objects [m]
OPEN_HAND = (0.0, 0.0, 0.0, 1.0)  # action of a hand that waits
PLACED_KEYS = ["joint_position", "joint_velocity", "object_pose", "object_velocity"]


def states_at_objects(env_id: str, *, seed: int, number: int = 32) -> TensorDict:
    """Make states in which the hand holds an object, or is beside it.

    With two objects, the states take them in turn. In half of these states the first
    object can be placed anywhere, and the last one is held up or lies on the table.

    Args:
        env_id: Id of the environment.
        seed: Seed of the objects' positions and of the side on which the hand stops.
        number: Number of attempts.

    Returns:
        States (n,) of robot and objects as in `RobotTaskEnv.get_state`, and whether the
        first object can be ``placed``. Failed attempts are left out, so n is at most
        ``number``.

    Raises:
        ValueError: The task has no objects on the table, or the robot is not under
            end-effector control.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(number, 1, generator=generator)

    with make(env_id, num_envs=number, seed=seed) as env, torch.no_grad():
        geometry = read_geometry(env)
        has_objects = isinstance(env.task, Push | Slide | Stack | Flip)
        if geometry is None or geometry.action is None or not has_objects:
            raise ValueError(
                "start_at_object needs end-effector control and one of the tasks Push, "
                f"PickAndPlace, Slide, Stack and Flip, got {env_id}: pass "
                "--start-at-object 0"
            )
        _, *objects = geometry.positions
        last = objects[-1]
        turns = [*objects, last, last] if len(objects) > 1 else objects
        turn = (torch.arange(number) % len(turns)).unsqueeze(1)
        place = torch.tensor(turns)[turn] + torch.arange(3)
        placed, waits = turn >= len(objects), turn > len(objects)
        angle, gap, lift = uniform(0, 2 * pi), uniform(*GAP), uniform(*LIFTED)
        beside = gap * torch.cat((angle.cos(), angle.sin(), 0 * angle), -1)
        blocked = env.action_spec_unbatched.shape[-1] == 3
        td = env.reset()
        for _ in range(APPROACH):
            observation = td["observation"]
            hand, width = observation[:, :3], observation[:, 6:7]
            item = observation.gather(1, place)
            if blocked:
                action = go_over(hand, item + beside, 0.1, limit=0.6)
                arrived = norm(item + beside - hand) < 0.01
            else:
                height = torch.where(placed, lift, item[:, 2:])
                goal = torch.cat((item[:, :2], height), 1)
                action = carry(hand, width, item, goal)
                arrived = is_held(hand, width, item) & (norm(goal - item) < 0.02)
                arrived = arrived | waits
                action = torch.where(waits, torch.tensor(OPEN_HAND), action)
            td = env.step(td.set("action", action))["next"]  # type: ignore[assignment]
        state = env.get_state().select(*PLACED_KEYS).set("placed", placed)
    speed = state["object_velocity"].abs().flatten(1).amax(1, keepdim=True)
    return state[(arrived & (speed < 0.1)).squeeze(1)]


class StartFrom(Transform):
    """Starts some episodes in given states, and keeps each episode's goal.

    Args:
        states: States (n,) of `states_at_objects`.
        ratio: Fraction of the episodes; torch's global generator chooses them.
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
        chosen = torch.rand(*env.batch_size, 1) < self.ratio
        requested = tensordict.get("_reset", None)
        if requested is not None:
            chosen &= requested.cpu()
        if not chosen.any():
            return tensordict_reset
        drawn = torch.randint(len(self.states), env.batch_size)
        state: TensorDict
        state = self.states[drawn].clone()  # type: ignore[assignment]  # a TensorDict
        placed: torch.Tensor = state.pop("placed")
        placed = placed.squeeze(-1)
        if placed.any():  # put the first object at the goal of its episode
            goal = tensordict_reset["desired_goal"].to(state["object_pose"])
            rest = goal.new_tensor((0.0, 0.0, 0.0, 1.0)).expand(len(goal), 4)
            pose, last = torch.cat((goal[:, :3], rest), 1), state["object_pose"][:, -1]
            # It must not touch the other object.
            free = (pose - last)[:, :3].norm(dim=1) > ROOM
            chosen &= (free | ~placed).unsqueeze(-1)
            if not chosen.any():
                return tensordict_reset
            state["object_pose"][placed, 0] = pose[placed]
            state["object_velocity"][placed, 0] = 0.0
        # The other environments keep the observations of their first reset.
        start = tensordict_reset.copy().update(state.to(env.device))
        start = env.reset(start.set("_reset", chosen.to(env.device)), set_state=True)
        return start.select(*tensordict_reset.keys(True, True))
