"""Exploration towards random points."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torch_panda
from tests.learning.gradient_steps import SPACES
from torch_panda.learning.agents import AGENTS, Hyperparameters, make_agent
from torch_panda.learning.agents.exploration import RandomPointModule
from torch_panda.learning.environments.geometry import Geometry

NUM_ENVS = 64


def make_module(
    eps, *, num_envs=NUM_ENVS, moves_joints=False, action_size=4, object_columns=()
):
    geometry = Geometry(
        points=(),
        origins=(),
        observation=(),
        goal=(),
        action=None,
        positions=(0, *object_columns),
        goal_positions=(),
        goal_height=None,
        orientation=None,
    )
    spaces = replace(
        SPACES,
        action_size=action_size,
        num_envs=num_envs,
        has_free_gripper=action_size in (4, 8),
        geometry=geometry,
        moves_joints=moves_joints,
    )
    return RandomPointModule(spaces, Hyperparameters(random_eps=(eps, eps)))


def explore(module, steps, action_size=4):
    """Actions (steps, num_envs, action_size) of a hand that does not move."""
    observation = torch.tensor((0.0, 0.0, 0.1)).expand(NUM_ENVS, 3)
    actions = []
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(steps):
            td = {"observation": observation, "action": torch.full((NUM_ENVS, 1), 9.0)}
            td["action"] = td["action"].expand(NUM_ENVS, action_size)
            actions.append(module(TensorDict(td, [NUM_ENVS]))["action"])
    return torch.stack(actions)


def test_actions_towards_a_point_have_noise():
    torch.manual_seed(0)
    module = make_module(1.0)
    changes = []
    for _ in range(100):
        gripper = explore(module, steps=1)[0, :, 3:]
        changes.append((gripper - module.gripper)[module.gripper.abs() < 0.3])
    assert torch.cat(changes).std() == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("eps", [0.0, 0.3])
def test_after_the_warm_up_the_ratio_of_exploring_steps_is_eps(eps):
    torch.manual_seed(0)
    # The three observed numbers are also the position of an object.
    module = make_module(eps, object_columns=(0,))
    warm_up = explore(module, steps=250)[..., 0]
    assert (warm_up != 9.0).all()
    explore(module, steps=12)  # the last moves of the warm-up end
    replaced = explore(module, steps=1000)[..., 0] != 9.0
    assert replaced.float().mean() == pytest.approx(eps, abs=0.015)


def test_without_objects_there_is_no_warm_up():
    assert (explore(make_module(0.0), steps=5)[..., 0] == 9.0).all()


def test_a_point_and_the_gripper_are_kept_for_several_steps():
    torch.manual_seed(0)
    module = make_module(0.3)
    moves, last = [], None
    for _ in range(500):
        explore(module, steps=1)
        now = (int(module.steps_left[0]), module.point[0].tolist())
        if last is not None and last[0] > 0:
            assert now[0] == last[0] - 1
            assert now[1] == last[1]
        elif now[0] > 0:
            moves.append(now[0] + 1)
        last = now
    assert min(moves) >= 4
    assert max(moves) <= 12
    assert len(set(moves)) > 3


def test_the_hand_reaches_points_of_the_region():
    """The real hand ends near the point, wherever the region has it."""
    torch.manual_seed(0)
    num_envs = 8
    module = make_module(1.0, num_envs=num_envs, action_size=3)
    with (
        torch_panda.make("PandaReach-v1", num_envs=num_envs, seed=0) as env,
        set_exploration_type(ExplorationType.RANDOM),
    ):
        td = env.reset()
        distances = []
        for _ in range(30):
            td["action"] = torch.zeros(num_envs, 3)
            td = module(td)
            arrives = module.steps_left == 0
            td = env.step(td)["next"]
            hand = td["observation"][:, :3]
            distances.append((hand - module.point).norm(dim=1)[arrives])
    assert torch.cat(distances[10:]).median() < 0.05
    low, high = torch.tensor((-0.2, -0.2, 0.0)), torch.tensor((0.2, 0.2, 0.08))
    assert ((module.point >= low) & (module.point <= high)).all()


def test_half_of_the_points_are_near_one_of_the_objects():
    torch.manual_seed(0)
    module = make_module(1.0, object_columns=(3, 6))
    centres = torch.tensor([[2.0, 1.0, 0.02], [-3.0, 1.0, 0.3]])
    observation = torch.cat((torch.zeros(3), centres.flatten()))
    points = torch.cat(
        [module._draw_points(observation.expand(NUM_ENVS, -1)) for _ in range(100)]
    )
    distance = (points[:, None, :2] - centres[:, :2]).abs().amax(-1)
    is_near = distance <= 0.1 + 1e-6
    assert is_near.float().mean(0).tolist() == pytest.approx([0.25, 0.25], abs=0.02)
    for near, z in zip(is_near.T, centres[:, 2].tolist(), strict=True):
        heights = points[near, 2]
        assert heights.min() == pytest.approx(max(0.0, z - 0.02), abs=0.005)
        assert heights.max() == pytest.approx(z + 0.06, abs=0.005)
    anywhere = points[~is_near.any(1)]
    low, high = torch.tensor((-0.2, -0.2, 0.0)), torch.tensor((0.2, 0.2, 0.08))
    assert ((anywhere >= low) & (anywhere <= high)).all()


def test_joint_control_spends_a_displacement():
    torch.manual_seed(0)
    module = make_module(1.0, moves_joints=True, action_size=8)
    explore(module, steps=1, action_size=8)
    first = module.point.clone()
    explore(module, steps=3, action_size=8)
    assert (module.point.abs() <= first.abs() + 1e-6).all()
    assert (module.point.abs() < first.abs()).any()


def test_a_deterministic_policy_is_left_alone():
    module = make_module(1.0)
    td = TensorDict(
        {"observation": torch.zeros(NUM_ENVS, 3), "action": torch.ones(NUM_ENVS, 4)},
        [NUM_ENVS],
    )
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(module(td)["action"], torch.ones(NUM_ENVS, 4))


@pytest.mark.parametrize("algo", AGENTS)
def test_every_agent_explores_by_random_points(algo):
    torch.manual_seed(0)
    hp = Hyperparameters(
        algo=algo, exploration="points", random_eps=(1.0, 1.0), noise_eps=0.0
    )
    with (
        torch_panda.make("PandaPickAndPlace-v1", num_envs=2, seed=0) as env,
        set_exploration_type(ExplorationType.RANDOM),
    ):
        agent = make_agent(env, hp)
        rollout = env.rollout(10, agent.explore, break_when_any_done=False)
    (module,) = (m for m in agent.modules() if isinstance(m, RandomPointModule))
    assert module.steps_left.any()
    assert any(key.endswith("steps_left") for key in agent.state_dict())
    assert not any("steps_left" in key for key in agent.policy.state_dict())
    assert rollout["action"].abs().max() <= 1.0


@pytest.mark.parametrize("control_type", ["ee_pose", "joint_velocity", "joint_torque"])
def test_points_need_a_control_type_that_moves_to_them(control_type):
    options = {"control_type": control_type}
    with (
        torch_panda.make("PandaReach-v1", num_envs=1, robot_options=options) as env,
        pytest.raises(ValueError, match='exploration "points" needs the control type'),
    ):
        make_agent(env, Hyperparameters(exploration="points"))


class HighReach(torch_panda.Reach):
    """Goals in a small box high above the table, and no declared layout."""

    goal_entries = None

    def sample_goal(self, rng):
        return rng.uniform((0.09, 0.09, 0.29), (0.11, 0.11, 0.31))


def test_points_lie_in_the_box_that_is_found():
    torch.manual_seed(0)
    hp = Hyperparameters(exploration="points", random_eps=(1.0, 1.0))
    robot = torch_panda.Panda(block_gripper=True)
    with torch_panda.RobotTaskEnv(
        robot=robot, task=HighReach(), num_envs=4, seed=0
    ) as env:
        agent = make_agent(env, hp)
        (module,) = (x for x in agent.explore.modules() if hasattr(x, "steps_left"))
        start = env.reset()
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            for _ in range(20):
                agent.explore(start.clone())
                offset = module.point - torch.tensor((0.1, 0.1, 0.3))
                assert (offset.abs() <= 0.0101).all()
