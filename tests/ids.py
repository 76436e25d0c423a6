"""Which ids the tests take."""

import torch_panda

# Those that differ in physics: sparse and dense rewards share theirs, which
# `test_suite.test_reward_types_share_their_physics` shows for each.
PHYSICS_IDS = tuple(env_id for env_id in torch_panda.ENV_IDS if "Dense" not in env_id)


def dense(env_id):
    """The id of the same physics with dense rewards."""
    return env_id.replace("-", "Dense-")
