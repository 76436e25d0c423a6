"""Training episodes that begin in the course of their task.

As long as nothing moves an object, hindsight goals teach nothing about it. The authors
of HER began half of the episodes of pick-and-place in one state in which the box is
grasped (arXiv 1707.01495, section 4.1), Lanier et al. stacks with some blocks in place
(arXiv 1906.03710). Here a scripted hand makes such states.
"""

from math import pi

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Transform

from torch_panda.experts.moves import carry, go_over, is_held, norm
from torch_panda.learning.geometry import read_geometry
from torch_panda.registry import make
from torch_panda.tasks import Flip, Push, Slide, Stack

APPROACH = 45  # steps
# How far beside an object a hand that cannot grasp stops, between the centres [m]: the
# fingers, at most 2.3 cm long and wide, do not touch a cube or puck there.
GAP = (0.055, 0.08)
# How high an object is held, of several the last, when the first is placed below [m].
LIFTED = (0.12, 0.2)
ROOM = 0.08  # [m] between the centres of two objects
OPEN_HAND = (0.0, 0.0, 0.0, 1.0)  # the action of a hand that waits
PHYSICAL = ["joint_position", "joint_velocity", "object_pose", "object_velocity"]


def states_at_objects(env_id: str, *, seed: int, number: int = 32) -> TensorDict:
    """States in which the hand holds an object, or is beside one if it cannot grasp.

    Where there are two objects they take turns; in half of the states the first can be
    put anywhere, and the last one is held up, or lies there yet.

    Args:
        env_id: one of torch_panda.ENV_IDS.
        seed: of the objects' positions and of the hand's side.
        number: how many to try.

    Returns:
        What `RobotTaskEnv.get_state` says of robot and objects, and whether the first
        object can be ``placed``, (n,), n at most ``number``: approaches that failed are
        left out.

    Raises:
        ValueError: the task has no objects on the table, or control is not of the
            end-effector.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(number, 1, generator=generator)

    with make(env_id, num_envs=number, seed=seed) as env, torch.no_grad():
        geometry = read_geometry(env)
        lies = isinstance(env.task, Push | Slide | Stack | Flip)
        if geometry is None or geometry.action is None or not lies:
            raise ValueError(
                "starts at objects need end-effector control and a task with objects "
                f"on the table, got {env_id}"
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
                there = norm(item + beside - hand) < 0.01
            else:
                height = torch.where(placed, lift, item[:, 2:])
                goal = torch.cat((item[:, :2], height), 1)
                action = carry(hand, width, item, goal)
                there = is_held(hand, width, item) & (norm(goal - item) < 0.02)
                there = there | waits
                action = torch.where(waits, torch.tensor(OPEN_HAND), action)
            td = env.step(td.set("action", action))["next"]  # type: ignore[assignment]
        state = env.get_state().select(*PHYSICAL).set("placed", placed)
    speed = state["object_velocity"].abs().flatten(1).amax(1, keepdim=True)
    return state[(there & (speed < 0.1)).squeeze(1)]


class StartFrom(Transform):
    """Lets some episodes begin in one of these states, with their own goals.

    Args:
        states: of `states_at_objects`, (n,).
        ratio: of the episodes that begin so, chosen at random by torch's generator.
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
        if placed.any():  # the first object is where the episode's goal has it
            goal = tensordict_reset["desired_goal"].to(state["object_pose"])
            rest = goal.new_tensor((0.0, 0.0, 0.0, 1.0)).expand(len(goal), 4)
            pose, last = torch.cat((goal[:, :3], rest), 1), state["object_pose"][:, -1]
            # There it must not meet the other one.
            free = (pose - last)[:, :3].norm(dim=1) > ROOM
            chosen &= (free | ~placed).unsqueeze(-1)
            if not chosen.any():
                return tensordict_reset
            state["object_pose"][placed, 0] = pose[placed]
            state["object_velocity"][placed, 0] = 0.0
        # With what was observed: torchrl takes it where nothing is reset again.
        start = tensordict_reset.copy().update(state.to(env.device))
        start = env.reset(start.set("_reset", chosen.to(env.device)), set_state=True)
        return start.select(*tensordict_reset.keys(True, True))
