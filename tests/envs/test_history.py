"""Hard-contact episodes before and after other ones: pytest -m slow -s on this file.

The default suite has a lighter version, `test_history_changes_nothing`. Stack and Flip
fail here, each for an episode or two: see the README on limits.
"""

import numpy as np
import pytest
import torch

import torch_panda
from tests.envs.test_parity import choose_action

EPISODES = 30
STEPS = 60


def play(env, td, actions):
    observations = []
    for action in actions:
        td = env.step(td.set("action", action))["next"]
        observations.append(td["observation"])
    return torch.stack(observations, dim=1)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["Push", "Slide", "PickAndPlace", "Stack", "Flip"])
def test_hard_contacts_after_another_history(task):
    env_id = f"Panda{task}-v3"
    with torch_panda.make(env_id, num_envs=EPISODES, seed=1) as env:
        td, actions = env.reset(), []
        state = env.get_state()
        rngs = [np.random.default_rng(k) for k in range(EPISODES)]
        for _ in range(STEPS):
            observation = td["observation"].numpy()
            size = env.action_spec.shape[-1]
            rows = [
                choose_action(env_id, row, rng, size)
                for row, rng in zip(observation, rngs, strict=True)
            ]
            actions.append(torch.from_numpy(np.stack(rows)))
            td = env.step(td.set("action", actions[-1]))["next"]
        first = play(env, env.reset(state.clone(), set_state=True), actions)
        for steps in (41, 50, 57):
            play(env, env.reset(), [a.roll(7, 0) for a in actions[:steps]])
        again = play(env, env.reset(state.clone(), set_state=True), actions)
    differ = int((first != again).flatten(1).any(dim=1).sum())
    print(f"{task}: {differ} of {EPISODES} episodes differ")
    assert differ == 0
