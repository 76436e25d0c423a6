"""Scripted experts solve their tasks from observations alone."""

import numpy as np
import pytest
import torch

import torch_panda
from torch_panda import experts
from torch_panda.experts.moves import sqrt


# An expert with the measured success rate misses these bounds once in 1,000 samples.
# Random actions succeed in one of nine episodes of Push, and more rarely elsewhere.
@pytest.mark.parametrize(
    ("env_id", "episodes", "least"),
    [
        ("PandaReach-v1", 16, 16),
        ("PandaPush-v1", 16, 15),
        ("PandaSlide-v1", 32, 20),
        ("PandaPickAndPlace-v1", 16, 15),
        ("PandaStack-v1", 16, 12),
        ("PandaFlip-v1", 48, 28),
        ("PandaDrawer-v1", 16, 15),
        ("PandaPegInsertion-v1", 16, 15),
        ("PandaPush-v3", 16, 13),
        ("PandaFlip-v3", 32, 20),
    ],
)
def test_an_expert_solves_its_task(env_id, episodes, least):
    result = torch_panda.evaluate(
        experts.make_expert(env_id),
        env_id,
        episodes=episodes,
        num_envs=8,
        seed=11,
    )
    assert result.success.sum() >= least


def test_the_upper_cube_is_pushed_out_of_the_way():
    """It leaves no room for the fingers beside the lower cube."""
    with torch_panda.make("PandaStack-v1", num_envs=4, seed=0) as env:
        env.reset()
        state = env.get_state()
        lower, upper = state["object_pose"][:, 0, :2], state["object_pose"][:, 1, :2]
        offset = torch.tensor([[0.0, 0.045], [0.0, -0.045], [0.0, 0.06], [0.0, -0.06]])
        upper[:] = lower + offset
        env.reset(state, set_state=True)
        td = env.rollout(100, experts.make_expert("PandaStack-v1"), auto_reset=False,
                         tensordict=env.reset(state, set_state=True))  # fmt: skip
    assert td["next", "success"][:, -1].sum() >= 3


@pytest.mark.parametrize("task", experts.EXPERTS)
def test_experts_act_within_the_limits(task):
    """Demonstrations hold the actions that the environment carries out."""
    env_id = f"Panda{task.__name__}-v1"
    with torch_panda.make(env_id, num_envs=4, seed=0) as env:
        td = env.fake_tensordict().expand(100, 4).clone()
    torch.manual_seed(0)
    td = td.exclude("next", "action").apply(lambda x: torch.randn_like(x.float()))
    action = experts.make_expert(env_id)(td)["action"]
    assert action.abs().max() <= 1.0


@pytest.mark.parametrize(
    "env_id", [f"Panda{task.__name__}-v1" for task in experts.EXPERTS]
)
def test_the_actions_of_an_environment_depend_on_its_observation_only(env_id):
    torch.manual_seed(0)
    expert = experts.make_expert(env_id)
    with torch_panda.make(env_id, num_envs=4, seed=0) as env:
        rollout = env.rollout(20, expert, break_when_any_done=False)
    keys = ["observation", "achieved_goal", "desired_goal"]
    order = torch.randperm(rollout.numel())
    shuffled = rollout.reshape(-1)[order]
    again = expert(shuffled.select(*keys))["action"]
    assert torch.allclose(again, shuffled["action"], atol=1e-5)


def test_a_single_environment_has_no_batch_dimension():
    with torch_panda.make("PandaFlip-v1", seed=0) as env:
        rollout = env.rollout(3, experts.make_expert("PandaFlip-v1"))
    assert rollout["action"].shape == (3, 4)


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("PandaPushJoints-v1", "^no expert for 'PandaPushJoints-v1': .* Reach, Push"),
        ("KukaReach-v1", "^no expert for 'KukaReach-v1': "),
        ("PandaFly-v1", "unknown environment id 'PandaFly-v1'"),
        ("FreePush-v0", "with block_gripper=True at Reach, Push, .*=False at PickAnd"),
    ],
)
def test_ids_without_an_expert_are_refused(env_id, message):
    torch_panda.register("FreePush-v0", robot=torch_panda.Panda, task=torch_panda.Push)
    with pytest.raises(ValueError, match=message):
        experts.make_expert(env_id)


@pytest.mark.parametrize(("table_friction", "expected"), [(0.1, "drag"), (0.5, "push")])
def test_the_friction_of_the_table_chooses_the_expert_of_push(table_friction, expected):
    task = torch_panda.Push(table_friction=table_friction)
    robot = torch_panda.Panda(block_gripper=True)
    assert experts.find_expert(robot, task) is getattr(experts.push, expected)


class PushFar(torch_panda.Push):
    """Another task, although it inherits from a shipped one."""


@pytest.mark.parametrize(
    ("robot", "task"),
    [
        (torch_panda.Panda(block_gripper=True), PushFar()),
        (torch_panda.Panda(), torch_panda.Push()),
        (torch_panda.Panda(block_gripper=True), torch_panda.Stack()),
        (torch_panda.XArm6(), torch_panda.Reach()),
    ],
)
def test_other_robots_and_tasks_have_no_expert(robot, task):
    assert experts.find_expert(robot, task) is None


def test_square_roots_are_correctly_rounded():
    """The last bit of torch's float32 roots depends on the processor."""
    values = torch.rand(10_000, generator=torch.Generator().manual_seed(0))
    assert (sqrt(values).numpy() == np.sqrt(values.numpy())).all()
