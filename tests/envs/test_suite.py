"""What holds for every id; a new task is tested without being named here."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda

OBSERVATION = {
    "Reach": 6,
    "Push": 18,
    "Slide": 18,
    "PickAndPlace": 19,
    "Stack": 31,
    "Flip": 20,
}
GOAL = {"Stack": 6, "Flip": 4}


@pytest.fixture(params=torch_panda.ENV_IDS)
def env_id(request):
    return request.param


@pytest.fixture
def env(env_id):
    with torch_panda.make(env_id, num_envs=3, num_threads=2, seed=0) as env:
        yield env


def parts(env_id):
    name, version = env_id.removeprefix("Panda").split("-")
    is_dense = name.endswith("Dense")
    name = name.removesuffix("Dense")
    has_joints = name.endswith("Joints")
    return name.removesuffix("Joints"), has_joints, is_dense, version


def test_ids_are_complete():
    assert len(torch_panda.ENV_IDS) == len(set(torch_panda.ENV_IDS)) == 48


def test_specs(env):
    check_env_specs(env)


def test_shapes_and_dtypes(env, env_id):
    task, has_joints, _, _ = parts(env_id)
    step = env.rollout(1)[:, 0]
    goal = GOAL.get(task, 3)
    gripper = task in ("PickAndPlace", "Stack", "Flip")
    assert step["observation"].shape == (3, OBSERVATION[task])
    assert step["action"].shape == (3, (7 if has_joints else 3) + gripper)
    for key in ("achieved_goal", "desired_goal"):
        assert step["next", key].shape == (3, goal)
        assert step["next", key].dtype == torch.float32
    assert step["next", "reward"].dtype == torch.float32
    for key in ("success", "terminated", "truncated", "done"):
        assert step["next", key].shape == (3, 1)
        assert step["next", key].dtype == torch.bool


def test_reward_and_success_follow_from_the_goals(env, env_id):
    _, _, is_dense, version = parts(env_id)
    after = env.rollout(10)["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    torch.testing.assert_close(after["reward"], env.compute_reward(*goals))
    assert torch.equal(after["success"], env.is_success(*goals))
    if not is_dense:
        assert torch.equal(after["reward"], after["success"].float() - 1)
    expected = after["success"] if version == "v3" else torch.zeros_like(after["done"])
    assert torch.equal(after["terminated"], expected)


def test_episode_is_truncated(env, env_id):
    task, _, _, version = parts(env_id)
    limit = 100 if task == "Stack" else 50
    rollout = env.rollout(limit + 5, break_when_any_done=False)
    if version == "v1":
        truncated = rollout["next", "truncated"][0, :, 0].nonzero().flatten().tolist()
        assert truncated == [limit - 1]
        assert torch.equal(rollout["next", "done"], rollout["next", "truncated"])
    else:
        # Success starts a new episode, and the count with it.
        assert not rollout["next", "truncated"][:, : limit - 1].any()


def test_no_output_aliases_another(env):
    td = env.rand_step(env.reset())
    before = td.clone()
    env.rand_step(env.reset())
    assert (td == before).all()


def test_observations_are_finite_and_vary(env, env_id):
    rollout = env.rollout(20, break_when_any_done=False)
    observation = rollout["next", "observation"]
    assert observation.isfinite().all()
    # With the gripper free or blocked, every entry moves in some episode.
    assert (observation[..., :6].std(dim=1) > 0).all()


def test_starts_differ(env, env_id):
    first, second = env.reset(), env.reset()
    assert not torch.equal(first["desired_goal"], second["desired_goal"])
    for td in (first, second):
        assert len(td["desired_goal"].unique(dim=0)) == 3


def test_same_seed_same_trajectory(env_id):
    rollouts = []
    for threads in (1, 2):
        with torch_panda.make(env_id, num_envs=3, num_threads=threads, seed=7) as env:
            torch.manual_seed(0)
            rollouts.append(env.rollout(15, break_when_any_done=False))
    assert (rollouts[0] == rollouts[1]).all()
