"""Ids of one environment for each physics, and for each version of a task."""

import torch_panda
from torch_panda.registry import find_registration

# One id for each physics. Sparse and dense rewards share theirs, which
# `test_suite.test_reward_types_share_their_physics_and_ends` shows for each.
PHYSICS_IDS = tuple(
    env_id
    for env_id in torch_panda.ENV_IDS
    if find_registration(env_id).make_task().reward_type == "sparse"
)

# One id for each class of a task and each version. Robots and control types share it.
TASK_IDS = tuple(
    {
        (type(find_registration(env_id).make_task()), env_id[-2:]): env_id
        for env_id in reversed(PHYSICS_IDS)
        if "Joints" not in env_id
    }.values()
)


def dense(env_id):
    """The id of the same physics with dense rewards."""
    return "Dense-".join(env_id.rsplit("-", 1))
