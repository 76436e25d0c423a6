"""Fixed evaluation tasks: named start states with goals, the same for everybody."""

import torch
from tensordict import TensorDict

from torch_panda.registry import Registration, find_registration, make

NUM_STARTS = 41  # starts from which the tasks are chosen
SEED = 0
# Name of each task, and the quantile of its distance between start and goal among the
# distances of all starts.
QUANTILES = {
    "very_near": 0.05,
    "near": 0.25,
    "medium": 0.5,
    "far": 0.75,
    "very_far": 0.95,
}

# The states of each id, and its registration. They are chosen only once in a process,
# because it takes seconds to build the environments from which they are chosen.
_CHOSEN: dict[str, tuple[Registration, dict[str, TensorDict]]] = {}


def evaluation_tasks(env_id: str) -> dict[str, TensorDict]:
    """Return five named start states of a task, each with its goal.

    They are selected from `NUM_STARTS` random starts of the task, by the distance
    between achieved and desired goal. Ids that you registered have them too.

    Args:
        env_id: Id of the task.

    Returns:
        States of batch size [] by name, for ``env.reset(state, set_state=True)``. The
        names are "very_near", "near", "medium", "far" and "very_far".

    Raises:
        ValueError: The id is unknown.
    """
    registration = find_registration(env_id)
    # An id can be registered again with another task.
    if env_id not in _CHOSEN or _CHOSEN[env_id][0] is not registration:
        _CHOSEN[env_id] = registration, _choose_starts(env_id)
    return {name: state.clone() for name, state in _CHOSEN[env_id][1].items()}


def _choose_starts(env_id: str) -> dict[str, TensorDict]:
    """Choose the states of `evaluation_tasks`."""
    with make(env_id, num_envs=NUM_STARTS, seed=SEED) as env:
        start = env.reset()
        distance = env.task.distance(start["achieved_goal"], start["desired_goal"])
        states = env.get_state()
    order = torch.argsort(distance.squeeze(-1), stable=True)
    chosen = {name: order[round(q * (NUM_STARTS - 1))] for name, q in QUANTILES.items()}
    # An index into a TensorDict gives a TensorDict.
    return {name: states[i].clone() for name, i in chosen.items()}  # type: ignore[misc]
