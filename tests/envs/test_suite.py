"""Tests that run over every registered id, so they include every new task."""

from itertools import product

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda
from tests.ids import PHYSICS_IDS, dense
from torch_panda.registry import find_registration

# Observation, goal and action size with end-effector control, and steps.
SIZES = {
    "Reach": (6, 3, 3, 50),
    "Push": (18, 3, 3, 50),
    "Slide": (18, 3, 3, 50),
    "PickAndPlace": (19, 3, 4, 50),
    "Stack": (31, 6, 4, 100),
    "Flip": (20, 4, 4, 50),
    "Drawer": (11, 3, 3, 50),
    "PegInsertion": (21, 3, 3, 50),
}
PAPER = ("Reach", "Push", "Slide", "PickAndPlace", "Stack", "Flip")
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


@pytest.mark.parametrize(
    ("task", "control", "version"),
    [
        *product(PAPER, ("", "Joints"), ("v1", "v3")),
        ("Drawer", "", "v1"),
        ("PegInsertion", "", "v1"),
    ],
)
def test_sizes_and_step_limits_are_those_of_the_contract(task, control, version):
    env_id = f"Panda{task}{control}-{version}"
    observation, goal, action, steps = SIZES[task]
    assert {env_id, dense(env_id)} <= set(torch_panda.ENV_IDS)
    with torch_panda.make(env_id) as env:
        specs, robot_joints = env.observation_spec, 4 * (control == "Joints")
        for key, size in (
            ("observation", observation),
            ("achieved_goal", goal),
            ("desired_goal", goal),
        ):
            assert (specs[key].shape, specs[key].dtype) == ((size,), torch.float32)
        assert env.action_spec.shape == (action + robot_joints,)
        assert env.action_spec.dtype == env.reward_spec.dtype == torch.float32
        for flag in (specs["success"], *env.full_done_spec.values()):
            assert (flag.shape, flag.dtype) == ((1,), torch.bool)
        assert env.max_episode_steps == steps
        assert env.terminate_on_success == (version == "v3")


def test_ids_are_unique():
    ids = torch_panda.ENV_IDS
    assert len(ids) == len(set(ids)) == 2 * len(PHYSICS_IDS)
    assert set(map(dense, PHYSICS_IDS)) | set(PHYSICS_IDS) == set(ids)


def test_an_id_names_its_robot_its_task_and_its_version():
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
    assert rewarded["truncated"].any(1).flatten().tolist() == [False] * 2 + [True] * 4


def test_an_episode_is_truncated_at_its_step_limit(env):
    limit = env.max_episode_steps
    assert limit == env.task.max_episode_steps
    # Start two steps before the end, to save the time of a whole episode.
    env.reset()
    state = env.get_state()
    state["step_count"][:] = limit - 2
    td = env.reset(state, set_state=True)
    ends = []
    for _ in range(2):
        td["action"] = torch.zeros(env.action_spec.shape)
        td = env.step(td)["next"]
        ends.append(td["truncated"].flatten().tolist())
        assert torch.equal(td["done"], td["truncated"] | td["terminated"])
    assert ends == [[False] * NUM_ENVS, [True] * NUM_ENVS]


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


def test_a_step_from_an_exact_state_repeats_bit_for_bit(env):
    torch.manual_seed(0)
    td = env.rollout(8, break_when_any_done=False)[:, -1]["next"].exclude("reward")
    state = env.get_state(exact=True)
    td["action"] = torch.rand(env.action_spec.shape) * 2 - 1
    expected = env.step(td.clone())["next"]
    again = env.reset(state, set_state=True)
    assert (env.step(again.set("action", td["action"]))["next"] == expected).all()
