"""The packed solver here against panda-gym with Bullet's own functions elsewhere.

The reference runs in a process of its own, which never loads the packed solver.
"""

import multiprocessing

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import torch_panda
from tests.envs.test_parity import KEYS, V3_IDS, choose_action
from tests.panda_gym_reference import make_reference, start
from tests.solver.solvers import needs_packed, solver
from torch_panda.bullet.solver import SOLVER_VARIABLE, activate

pytestmark = needs_packed
EPISODES, STEPS = 2, 60


def record(env_id):
    """Episodes of panda-gym, and the solver of this process."""
    reference = make_reference(env_id)
    episodes = []
    for seed in range(EPISODES):
        rng = np.random.default_rng(seed)
        observation, poses, goal = start(reference, seed=seed)
        observations, actions = [observation], []
        for _ in range(STEPS):
            action = choose_action(
                env_id, observation["observation"], rng, len(reference.action_space.low)
            )
            observation, *_ = reference.step(action)
            observations.append(observation)
            actions.append(action)
        episodes.append((poses, goal, actions, observations))
        # panda-gym's episodes depend on earlier ones, so start each in a new client.
        reference.close()
        reference = make_reference(env_id)
    reference.close()
    return episodes, activate().name


@pytest.fixture(scope="module")
def other_process():
    with pytest.MonkeyPatch.context() as context:
        context.setenv(SOLVER_VARIABLE, "bullet")
        pool = multiprocessing.get_context("spawn").Pool(1)
    with pool:
        yield pool


@pytest.mark.parametrize("env_id", V3_IDS)
def test_equals_panda_gym_of_another_process(other_process, env_id):
    episodes, their_solver = other_process.apply(record, (env_id,))
    assert (their_solver, activate().name) == ("bullet", "packed")
    poses, goals, actions, theirs = zip(*episodes, strict=True)
    with (
        solver("packed") as library,
        torch_panda.make(env_id, num_envs=EPISODES, num_threads=1, seed=0) as env,
    ):
        state = {"object_pose": np.stack(poses), "desired_goal": np.stack(goals)}
        ours = env.reset(TensorDict(state, [EPISODES]), set_state=True)
        for step in range(STEPS + 1):
            for key in KEYS:
                expected = np.stack([episode[step][key] for episode in theirs])
                assert np.array_equal(ours[key].numpy(), expected), (key, step)
            if step < STEPS:
                action = np.stack([episode[step] for episode in actions])
                ours = env.step(ours.set("action", torch.from_numpy(action)))["next"]
        counts = library.counts()
    assert counts.groups > 0
    assert counts.bullet_groups < counts.groups / 10  # a few are left to Bullet
