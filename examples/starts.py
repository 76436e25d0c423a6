"""Training episodes that begin with the hand at an object.

As long as nothing moves an object, hindsight goals teach nothing about it. The authors
of HER began half of the episodes of pick-and-place in one state in which the box is
grasped (arXiv 1707.01495, section 4.1). Here a scripted hand makes such states.
"""

from math import pi

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Transform

import torch_panda
from experts.moves import carry, go_over, is_held, norm
from geometry import read_geometry

APPROACH = 35  # steps
# How far beside an object a hand that cannot grasp stops, between the centres [m]: the
# fingers, at most 2.3 cm long and wide, do not touch a cube or puck there.
GAP = (0.055, 0.08)
PHYSICAL = ["joint_position", "joint_velocity", "object_pose", "object_velocity"]


def states_at_objects(env_id: str, *, seed: int, number: int = 32) -> TensorDict:
    """States in which the hand holds an object, or is beside one if it cannot grasp.

    Where there are several objects, they take turns.

    Args:
        env_id: one of torch_panda.ENV_IDS.
        seed: of the objects' positions and of the hand's side.
        number: how many to try.

    Returns:
        What `RobotTaskEnv.get_state` says of robot and objects, (n,), n at most
        ``number``: approaches that failed are left out.

    Raises:
        ValueError: the task has no objects, or control is not of the end-effector.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch_panda.make(env_id, num_envs=number, seed=seed) as env, torch.no_grad():
        geometry = read_geometry(env)
        _, *objects = geometry.positions
        if not objects or geometry.action is None:
            raise ValueError(
                "starts at objects need end-effector control and a task with objects, "
                f"got {env_id}"
            )
        turns = torch.tensor(objects)[torch.arange(number) % len(objects), None]
        place = turns + torch.arange(3)
        low, high = GAP
        gap = low + (high - low) * torch.rand(number, 1, generator=generator)
        angle = 2 * pi * torch.rand(number, 1, generator=generator)
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
                action = carry(hand, width, item, item)
                there = is_held(hand, width, item)
            td = env.step(td.set("action", action))["next"]
        state = env.get_state().select(*PHYSICAL)
    speed = state["object_velocity"].abs().flatten(1).amax(1, keepdim=True)
    return state[(there & (speed < 0.1)).squeeze(1)]


class StartFrom(Transform):
    """Lets some episodes begin in one of these states, with their own goals.

    Args:
        states: of robots and objects, (n,).
        share: of the episodes that begin so, chosen at random by torch's generator.
    """

    def __init__(self, states: TensorDict, share: float) -> None:
        super().__init__()
        self.states = states
        self.share = share

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        env = self.parent.base_env
        chosen = torch.rand(*env.batch_size, 1) < self.share
        requested = tensordict.get("_reset", None)
        if requested is not None:
            chosen &= requested.cpu()
        if not chosen.any():
            return tensordict_reset
        start = self.states[torch.randint(len(self.states), env.batch_size)]
        # With what was observed: torchrl takes it where nothing is reset again.
        start = tensordict_reset.copy().update(start.to(env.device))
        start = env.reset(start.set("_reset", chosen.to(env.device)), set_state=True)
        return start.select(*tensordict_reset.keys(True, True))
