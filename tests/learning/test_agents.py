"""Agents: networks, target and averaged weights, exploration, and refused options.

Losses and gradient steps are in test_losses.py.
"""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP

import torch_panda
from tests.learning.gradient_steps import SPACES
from tests.learning.transitions import make_transitions
from torch_panda.learning.agents import AGENTS, Hyperparameters, make_agent

ALGOS = list(AGENTS)


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaPush-v1", num_envs=4) as env:
        yield env


def make(env, algo, **options):
    torch.manual_seed(0)
    return make_agent(env, Hyperparameters(algo=algo, **options))


class PushForOne(torch_panda.Push):
    """Rewards success with 1 and all else with 0."""

    def compute_reward(self, achieved_goal, desired_goal):
        return self.is_success(achieved_goal, desired_goal).float()


class PushGently(torch_panda.Push):
    """Adds a penalty on large actions to the sparse reward."""

    def reward(self, simulation, action, achieved_goal, desired_goal):
        sparse = super().reward(simulation, action, achieved_goal, desired_goal)
        return sparse - action.square().sum(-1, keepdim=True)


@pytest.mark.parametrize(
    ("task", "gamma", "expected"),
    [
        (torch_panda.Push(), 0.75, -4.0),
        (torch_panda.Push(), None, -50.0),  # the default is 1 - 1 / 50
        (torch_panda.Push(), 1.0, -math.inf),
        (torch_panda.Push(reward_type="dense"), 0.75, None),
        (PushForOne(), 0.75, None),
        (PushGently(), 0.75, None),
    ],
)
def test_only_the_librarys_own_sparse_rewards_bound_returns(task, gamma, expected):
    scene = {"robot": torch_panda.Panda(block_gripper=True), "task": task}
    with torch_panda.RobotTaskEnv(**scene, num_envs=1) as env:
        bound = make(env, "ddpg", gamma=gamma).min_return
    assert bound == (expected if expected is None else pytest.approx(expected))


@pytest.mark.parametrize(
    ("algo", "network", "size", "is_normalized"),
    [
        ("ddpg", "paper", 256, False),
        ("ddpg", "layer-norm", 256, True),
        *((algo, "wide", 448, True) for algo in ALGOS),
    ],
)
def test_networks_have_three_hidden_layers(algo, network, size, is_normalized):
    agent = AGENTS[algo](SPACES, Hyperparameters(algo=algo, network=network))
    modules = [*agent.modules()]
    if algo == "sac":  # torchrl's loss hides the module of the critics
        modules += agent.loss.qvalue_network.modules()
    networks = [m for m in modules if isinstance(m, MLP)]
    assert len(networks) >= 2
    for layers in networks:
        linear = [m for m in layers if isinstance(m, nn.Linear)]
        assert [m.out_features for m in linear[:-1]] == [size] * 3
        norms = [m for m in layers if isinstance(m, nn.LayerNorm)]
        assert len(norms) == (3 if is_normalized else 0)


def actor_weights(policy):
    """A copy of the weights of the actor in `policy` or `explore`."""
    return [x.detach().clone() for x in policy.module[1].parameters()]


@pytest.mark.parametrize("algo", ALGOS)
def test_the_policy_averages_the_weights_of_the_actor(env, algo):
    agent = make(env, algo, ema_rate=0.25)
    average = actor_weights(agent.policy)
    for step in (agent.update, agent.update, agent.imitate):
        step(make_transitions(env, 16))
        trained = actor_weights(agent.explore)
        average = [a.lerp(b, 0.25) for a, b in zip(average, trained, strict=True)]
        torch.testing.assert_close(actor_weights(agent.policy), average)
        assert not torch.equal(trained[0], average[0])


def make_explorer(algo, num_envs, **options):
    """An agent, and inputs of its policy for as many environments."""
    torch.manual_seed(0)
    spaces = replace(SPACES, num_envs=num_envs)
    agent = AGENTS[algo](spaces, Hyperparameters(algo=algo, **options))
    td = {
        "observation": torch.randn(num_envs, spaces.observation_size),
        "desired_goal": torch.randn(num_envs, spaces.goal_size),
    }
    return agent, TensorDict(td, [num_envs])


def deviations(agent, td):
    """Explored minus deterministic actions, (num_envs, action size)."""
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        explored = agent.explore(td.clone())["action"]
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return explored - agent.policy(td.clone())["action"]


@pytest.mark.parametrize("algo", ["ddpg", "td3", "crl"])
@pytest.mark.parametrize("options", [{}, {"noise_eps": 0.05}])
def test_actions_have_gaussian_noise(algo, options):
    agent, td = make_explorer(algo, 2_000, random_eps=(0.0, 0.0), **options)
    noise = deviations(agent, td)
    assert noise.std() == pytest.approx(options.get("noise_eps", 0.2), rel=0.05)
    assert abs(float(noise.mean())) < 0.01


def test_random_policies_explore():
    agent, td = make_explorer("sac", 2_000)
    assert deviations(agent, td).std() > 0.1


def test_environments_explore_differently():
    agent, td = make_explorer("ddpg", 4, noise_eps=0.0, random_eps=(0.0, 1.0))
    rounds = [(deviations(agent, td) != 0).any(-1) for _ in range(99)]
    share = torch.stack(rounds).double().mean(0)
    assert share[[0, -1]].tolist() == [0.0, 1.0]
    assert share.tolist() == pytest.approx([0.0, 1 / 3, 2 / 3, 1.0], abs=0.12)


@pytest.mark.parametrize("algo", ALGOS)
def test_fine_fingers_make_networks_choose_cube_roots(algo):
    """Networks choose cube roots of finger actions; environments get the actions."""
    seen, executed = [], []
    with torch_panda.make("PandaPickAndPlace-v1", num_envs=2, seed=0) as env:
        agent = make(env, algo, fine_fingers=True, random_eps=(0.0, 0.0))
        plain = make(env, algo, random_eps=(0.0, 0.0))
        batch, td = make_transitions(env, 64), env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        for policy in ("policy", "explore"):
            torch.manual_seed(1)
            seen.append(getattr(plain, policy)(td.clone())["action"])
            torch.manual_seed(1)
            executed.append(getattr(agent, policy)(td.clone())["action"])
    seen, executed = torch.stack(seen), torch.stack(executed)
    assert torch.equal(executed[..., :3], seen[..., :3])
    torch.testing.assert_close(executed[..., 3], seen[..., 3] ** 3)
    roots, fingers = batch.clone(), batch["action"][:, 3]
    roots["action"][:, 3] = fingers.sign() * fingers.abs() ** (1 / 3)
    for learn in ("update", "imitate"):
        torch.manual_seed(2)
        result = getattr(agent, learn)(batch.clone())
        torch.manual_seed(2)
        torch.testing.assert_close(result, getattr(plain, learn)(roots.clone()))


@pytest.mark.parametrize(
    ("env_id", "options", "message"),
    [
        ("PandaPush-v1", {"fine_fingers": True}, "needs a task whose actions move the"),
        ("PandaPushJoints-v1", {"augmentation": "mirror"}, "pass --augmentation none"),
    ],
)
def test_options_that_do_not_fit_the_task_are_refused(env_id, options, message):
    with torch_panda.make(env_id, num_envs=1) as env:
        with pytest.raises(ValueError, match=message):
            make(env, "ddpg", **options)
        make(env, "ddpg")
