"""Tests that run over every registered id, so they include every new task."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda
from tests.ids import PHYSICS_IDS, dense
from torch_panda.registry import find_registration

NUM_ENVS = 2


@pytest.fixture(scope="module", params=PHYSICS_IDS)
def made(request):
    """One environment for all tests of an id."""
    with torch_panda.make(request.param, num_envs=NUM_ENVS, num_threads=2) as env:
        yield request.param, env


@pytest.fixture
def env_id(made):
    return made[0]


@pytest.fixture
def env(made):
    made[1].set_seed(0)
    return made[1]


def test_ids_are_unique():
    ids = torch_panda.ENV_IDS
    assert len(ids) == len(set(ids)) == 2 * len(PHYSICS_IDS)
    assert set(map(dense, PHYSICS_IDS)) | set(PHYSICS_IDS) == set(ids)


def test_an_id_names_its_robot_its_task_and_its_version():
    assert len(torch_panda.ENV_IDS) == 64
    for env_id in torch_panda.ENV_IDS:
        registration = find_registration(env_id)
        robot, task = registration.make_robot(), registration.make_task()
        control = {"joints": "Joints", "ee": ""}[robot.control_type]
        reward = {"dense": "Dense", "sparse": ""}[task.reward_type]
        version = "v3" if registration.terminate_on_success else "v1"
        name = f"{type(robot).__name__}{type(task).__name__}"
        assert env_id == f"{name}{control}{reward}-{version}"


def test_resets_and_steps_agree_with_the_specs(env):
    check_env_specs(env)


def test_reward_success_and_ends_follow_from_the_goals(env):
    after = env.rollout(10)["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    assert torch.equal(after["reward"], env.compute_reward(*goals))
    assert torch.equal(after["success"], env.is_success(*goals))
    assert torch.equal(after["reward"], after["success"].float() - 1)
    ends = env.terminate_on_success
    assert torch.equal(after["terminated"], after["success"] & ends)


def test_goal_indices_are_where_observations_have_the_achieved_goal(env):
    indices = env.goal_indices
    assert isinstance(indices, tuple)
    after = env.rollout(5)["next"]
    observed = after["observation"][..., list(indices)]
    assert torch.equal(observed, after["achieved_goal"])


def test_reward_types_share_their_physics_and_ends(env, env_id):
    actions = torch.rand(6, *env.action_spec.shape) * 2 - 1

    def step_through(env):
        env.reset()
        state, steps = env.get_state(), []
        state["step_count"][:] = env.max_episode_steps - 3
        td = env.reset(state, set_state=True)
        for action in actions:
            td = env.step(td.clone().set("action", action))["next"]
            steps.append(td)
        return torch.stack(steps)

    sparse = step_through(env)
    with torch_panda.make(dense(env_id), num_envs=NUM_ENVS, seed=0) as other:
        rewarded = step_through(other)
        goals = rewarded["achieved_goal"], rewarded["desired_goal"]
        assert torch.equal(rewarded["reward"], other.compute_reward(*goals))
        assert len(rewarded["reward"].unique()) > len(sparse["reward"].unique())
    assert (rewarded.exclude("reward") == sparse.exclude("reward")).all()
    ended = rewarded["terminated"] | rewarded["truncated"]
    assert torch.equal(rewarded["done"], ended)
    assert rewarded["truncated"].any(1).flatten().tolist() == [False] * 2 + [True] * 4


def test_no_output_aliases_another(env):
    td = env.rand_step(env.reset())
    before = td.clone()
    env.rand_step(env.reset())
    assert (td == before).all()


def test_goals_differ_between_environments_and_episodes(env):
    first, second = env.reset(), env.reset()
    assert not torch.equal(first["desired_goal"], second["desired_goal"])
    for td in (first, second):
        assert len(td["desired_goal"].unique(dim=0)) == NUM_ENVS


def test_same_seed_same_trajectory(env, env_id):
    """Neither the number of threads nor earlier episodes change a trajectory."""
    torch.manual_seed(0)
    expected = env.rollout(10, break_when_any_done=False)
    with torch_panda.make(env_id, num_envs=NUM_ENVS, num_threads=1, seed=0) as other:
        torch.manual_seed(0)
        repeated = other.rollout(10, break_when_any_done=False)
    assert (repeated == expected).all()
