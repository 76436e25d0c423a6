"""Episodes with hard contacts do not depend on earlier episodes.

The arm is sent at the objects, often out of range, and presses on the table: then the
order in which Bullet solves contacts shows. `test_suite.test_same_seed_same_trajectory`
covers every id with lighter episodes.
"""

import numpy as np
import pytest
import torch

import torch_panda
from tests.envs.test_exact_state import follow
from tests.envs.test_parity import choose_actions

STEPS = 60
# Lengths of the earlier episodes [steps]. Their numbers of substeps, 20 per step,
# differ modulo every power of two above 4.
HISTORY = (41, 50, 57)


def count_differences(env_id, episodes):
    """Number of episodes that differ after one, or after three, other episodes."""
    with torch_panda.make(env_id, num_envs=episodes, seed=1) as env:
        td, actions, first = env.reset(), [], []
        state = env.get_state()
        rngs = [np.random.default_rng(k) for k in range(episodes)]
        for _ in range(STEPS):
            size = env.action_spec.shape[-1]
            actions.append(choose_actions(env_id, td["observation"], rngs, size))
            td = env.step(td.set("action", actions[-1]))["next"]
            first.append(td["observation"])
        again = follow(env, env.reset(state.clone(), set_state=True), actions)[
            "observation"
        ]
        for steps in HISTORY:
            follow(env, env.reset(), [a.roll(7, 0) for a in actions[:steps]])
        later = follow(env, env.reset(state.clone(), set_state=True), actions)[
            "observation"
        ]
    first = torch.stack(first, dim=1)
    differ = (first != again) | (first != later)
    return int(differ.flatten(1).any(dim=1).sum())


def test_hard_contacts_do_not_depend_on_earlier_episodes():
    assert count_differences("PandaStack-v3", 8) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "episodes"),
    [("Push", 30), ("Slide", 30), ("PickAndPlace", 100), ("Stack", 100), ("Flip", 100)],
)
def test_many_hard_contacts_do_not_depend_on_earlier_episodes(task, episodes):
    assert count_differences(f"Panda{task}-v3", episodes) == 0
