"""Scripted experts: they show that each task can be solved, and give demonstrations.

An expert maps a batch of observations and goals to actions of end-effector control. It
has no state and sees no simulator: what to do next follows from the observation alone,
so experts serve rollouts and collectors of any batch size. Positions are in the world
frame [m]; an action of 1 displaces the end-effector by 5 cm.
"""

import re
from collections.abc import Callable
from functools import partial

from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor

from torch_panda.experts import (
    drawer,
    flip,
    peg_insertion,
    pick_and_place,
    push,
    reach,
    slide,
    stack,
)
from torch_panda.registry import ENV_IDS

# (observation, achieved_goal, desired_goal), each (..., size), to the action.
Expert = Callable[[Tensor, Tensor, Tensor], Tensor]

EXPERTS: dict[str, Expert] = {
    "Reach": reach.act,
    "Push": push.drag,
    "Slide": slide.act,
    "PickAndPlace": pick_and_place.act,
    "Stack": stack.act,
    "Flip": flip.act,
    "Drawer": drawer.act,
    "PegInsertion": peg_insertion.act,
}
# On the rougher table of -v3 a cube can be pushed, and spins less.
V3_EXPERTS: dict[str, Expert] = EXPERTS | {
    "Push": push.push,
    "Flip": partial(flip.act, table=flip.ROUGH),
}


def make_expert(env_id: str) -> TensorDictModule:
    """The policy for an id of end-effector control.

    Raises:
        ValueError: there is no expert for it.
    """
    match = re.fullmatch(r"Panda([A-Za-z]+?)(Dense)?-v([13])", env_id)
    if match is None or match[1] not in EXPERTS or env_id not in ENV_IDS:
        raise ValueError(
            f"no expert for {env_id!r}; there are experts for the ids of "
            f"{', '.join(EXPERTS)} with end-effector control"
        )
    expert = (EXPERTS if match[3] == "1" else V3_EXPERTS)[match[1]]

    def act(*observed: Tensor) -> Tensor:
        # The environment clips what is beyond; who imitates it must see what it does.
        return expert(*observed).clamp(-1.0, 1.0)

    keys: list[NestedKey] = ["observation", "achieved_goal", "desired_goal"]
    return TensorDictModule(act, keys, ["action"])
