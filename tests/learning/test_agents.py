"""Agents: losses, effects of gradient steps, and exploration."""

import copy
import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP
from torchrl.objectives import DDPGLoss, TD3Loss

import torch_panda
from tests.learning.transitions import make_transitions
from torch_panda.learning.agents import AGENTS, CRL, Hyperparameters, make_agent
from torch_panda.learning.agents.base import TAU
from torch_panda.learning.agents.ddpg import SATURATION_L2
from torch_panda.learning.agents.td3 import NOISE_CLIP, POLICY_NOISE

ALGOS = list(AGENTS)
WITH_TARGETS = [algo for algo in ALGOS if algo != "crl"]  # with target networks


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaPush-v1", num_envs=4) as env:
        yield env


def make(env, algo, **options):
    torch.manual_seed(0)
    return make_agent(env, Hyperparameters(algo=algo, **options))


def critics_of(agent):
    """The parameters of the critics, and of their target networks."""
    if isinstance(agent, CRL):
        return [*agent.phi.parameters(), *agent.psi.parameters()], []
    if hasattr(agent, "critics"):
        return list(agent.critics.parameters()), list(agent.target_critics.parameters())
    keys = agent.loss.qvalue_network_params.keys(True, True)
    loss = agent.loss
    return tuple(
        [parameters[key] for key in keys]
        for parameters in (
            loss.qvalue_network_params,
            loss.target_qvalue_network_params,
        )
    )


def normalized(agent, batch):
    """Add the networks' inputs to a batch, for torchrl's losses."""
    for part in (batch, batch["next"]):
        part["normalized"] = agent.normalizer(part["observation"], part["desired_goal"])
    return batch


def as_modules(agent):
    actor = TensorDictModule(copy.deepcopy(agent.actor), ["normalized"], ["action"])
    keys = (["normalized", "action"], ["state_action_value"])
    return actor, [TensorDictModule(copy.deepcopy(c), *keys) for c in agent.critics]


def saturation(agent, batch):
    """The term of our actor's loss that torchrl's lacks, without the action penalty."""
    state = agent.normalizer(batch["observation"], batch["desired_goal"])
    return SATURATION_L2 * agent.actor[0](state).square().mean().detach()


def test_ddpg_has_torchrls_losses(env):
    agent = make(env, "ddpg", action_l2=0.0)
    batch = make_transitions(env, 64)
    actor, (critic,) = as_modules(agent)
    loss = DDPGLoss(actor, critic, delay_actor=True, loss_function="l2")
    loss.make_value_estimator(gamma=agent.gamma)
    agent.min_return = None  # torchrl does not clip targets
    theirs = loss(normalized(agent, batch.clone()))
    penalty = saturation(agent, batch)
    ours = agent.update(batch)
    torch.testing.assert_close(ours["critic_loss"], theirs["loss_value"])
    torch.testing.assert_close(ours["actor_loss"], theirs["loss_actor"] + penalty)


@pytest.mark.parametrize("double_q", [True, False])
def test_td3_has_torchrls_losses(env, double_q):
    agent = make(env, "td3", action_l2=0.0, double_q=double_q)
    agent.min_return = None
    batch = make_transitions(env, 64)
    actor, critics = as_modules(agent)
    assert len(critics) == 1 + double_q
    options = {"policy_noise": POLICY_NOISE, "noise_clip": NOISE_CLIP}
    loss = TD3Loss(
        actor,
        critics,
        num_qvalue_nets=len(critics),
        action_spec=env.action_spec_unbatched,
        loss_function="l2",
        deactivate_vmap=True,
        **options,
    )
    loss.make_value_estimator(gamma=agent.gamma)
    torch.manual_seed(1)
    # torchrl draws the noise of the targets first, too.
    theirs = loss.value_loss(normalized(agent, batch.clone()))[0]
    policy_loss = loss.actor_loss(normalized(agent, batch.clone()))[0]
    penalty = saturation(agent, batch)
    torch.manual_seed(1)
    ours = agent.update(batch)
    torch.testing.assert_close(ours["critic_loss"], theirs)
    torch.testing.assert_close(ours["actor_loss"], policy_loss + penalty)


@pytest.mark.parametrize("algo", ["ddpg", "td3"])
def test_targets_are_possible_returns(env, algo):
    """A critic with an impossible value is pulled to an end of the possible returns."""
    agent = make(env, algo, gamma=0.5, action_l2=0.0)
    batch = make_transitions(env, 64)
    for value, end in ((1000.0, 0.0), (-1000.0, -2.0)):
        for critics in (agent.critics, agent.target_critics):
            for critic in critics:
                nn.init.zeros_(critic[-1].weight)
                nn.init.constant_(critic[-1].bias, value)
        terminated = batch["next", "terminated"]
        # An episode that ends without success is worth the least possible return.
        at_end = 2.0 * batch["next", "reward"]
        target = torch.where(terminated, at_end, end)
        expected = len(agent.critics) * (value - target).square().mean()
        losses = copy.deepcopy(agent).update(batch.clone())
        torch.testing.assert_close(losses["critic_loss"], expected)


@pytest.mark.parametrize("algo", list(AGENTS))
def test_failing_early_does_not_save_rewards(env, algo):
    """A terminated row without success counts as if the episode went on forever."""
    agent = make(env, algo, gamma=0.75)
    seen = []
    backward = agent.backward

    def remember(state, rows, num_demos):
        seen.append(rows)
        return backward(state, rows, num_demos)

    agent.backward = remember
    batch = make_transitions(env, 64)
    terminated, reward = batch["next", "terminated"], batch["next", "reward"]
    failed = terminated & (reward == -1)
    assert failed.any() & (terminated & ~failed).any()
    agent.update(batch)
    assert torch.equal(seen[0].reward, torch.where(failed, -4.0, reward))


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
        (torch_panda.Push(), 1.0, -math.inf),
        (torch_panda.Push(reward_type="dense"), 0.75, None),
        (PushForOne(), 0.75, None),
        (PushGently(), 0.75, None),
    ],
)
def test_only_the_librarys_own_sparse_rewards_bound_returns(task, gamma, expected):
    scene = {"robot": torch_panda.Panda(block_gripper=True), "task": task}
    with torch_panda.RobotTaskEnv(**scene, num_envs=1) as env:
        assert make(env, "ddpg", gamma=gamma).min_return == expected


@pytest.mark.parametrize("algo", ["ddpg", "td3"])
def test_small_actions_are_preferred(env, algo):
    batch = make_transitions(env, 64)
    losses = [
        make(env, algo, action_l2=weight).update(batch.clone())["actor_loss"]
        for weight in (0.0, 2.0)
    ]
    agent = make(env, algo)
    state = agent.normalizer(batch["observation"], batch["desired_goal"])
    penalty = 2 * agent.actor(state).square().mean()
    torch.testing.assert_close(losses[1] - losses[0], penalty)


@pytest.mark.parametrize(
    ("network", "size", "is_normalized"),
    [("paper", 256, False), ("layer-norm", 256, True), ("wide", 448, True)],
)
@pytest.mark.parametrize("algo", ALGOS)
def test_a_gradient_step_trains_all_networks(env, algo, network, size, is_normalized):
    agent = make(env, algo, network=network)
    before = {key: x.clone() for key, x in agent.named_parameters()}
    trained = {key for key, x in agent.named_parameters() if x.requires_grad}
    losses = agent.update(make_transitions(env, 64))
    assert losses.keys() == {"critic_loss", "actor_loss"}
    assert not any(x.requires_grad for x in losses.values())
    after = dict(agent.named_parameters())
    same = {key for key in trained if torch.equal(before[key], after[key])}
    assert not {key for key in same if "alpha" not in key}
    norms = [m for m in agent.modules() if isinstance(m, nn.LayerNorm)]
    assert bool(norms) == is_normalized
    hidden = [x for m in agent.modules() if isinstance(m, MLP) for x in list(m)[:-1]]
    sizes = {x.out_features for x in hidden if isinstance(x, nn.Linear)}
    assert sizes == {size}


@pytest.mark.parametrize("algo", WITH_TARGETS)
def test_target_networks_follow_the_trained_networks(env, algo):
    agent = make(env, algo)
    before = [x.clone() for x in critics_of(agent)[1]]
    agent.update(make_transitions(env, 64))
    online, target = critics_of(agent)
    moved = [a.lerp(b, TAU) for a, b in zip(before, online, strict=True)]
    torch.testing.assert_close([x.data for x in target], [x.data for x in moved])


@pytest.mark.parametrize("algo", WITH_TARGETS)
def test_target_networks_move_at_intervals(env, algo):
    agent = make(env, algo, target_interval=3)
    before = critics_of(agent)[1][0].clone()
    moves = []
    for _ in range(6):
        agent.update(make_transitions(env, 16))
        after = critics_of(agent)[1][0].clone()
        moves.append(not torch.equal(before, after))
        before = after
    assert moves == [False, False, True] * 2


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


def test_td3_moves_its_actor_at_every_second_step(env):
    agent = make(env, "td3")
    keys = [agent.update(make_transitions(env, 16)).keys() for _ in range(4)]
    assert [len(k) for k in keys] == [2, 1, 2, 1]


@pytest.mark.parametrize(("algo", "double_q"), [("sac", True), ("tqc", False)])
def test_double_q_chooses_between_one_and_two_critics(env, algo, double_q):
    agent = make(env, algo, double_q=double_q)
    layers = [x for x in critics_of(agent)[0] if x.shape[-1] == agent.state_size + 3]
    assert [x.shape[0] for x in layers] == [1 + double_q]


def test_environments_explore_differently(env):
    agent = make(env, "ddpg", noise_eps=0.0, random_eps=(0.0, 1.0))
    td = env.reset()
    with torch.no_grad():
        policy = agent.policy(td.clone())["action"]
        rounds = torch.stack(
            [(agent.explore(td.clone())["action"] != policy).any(-1) for _ in range(99)]
        )
    share = rounds.double().mean(0)
    assert share[0] == 0
    assert share[-1] == 1
    assert 0.1 < share[1] < share[2] < 0.9


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


def test_fine_fingers_need_fingers(env):
    with pytest.raises(
        ValueError, match="fine_fingers needs a task whose actions move the fingers"
    ):
        make(env, "ddpg", fine_fingers=True)
