"""What a gradient step and learning cost: pytest -m slow -s <this file>."""

import copy
import itertools
import statistics
import time
from dataclasses import dataclass, replace
from functools import partial

import gymnasium
import numpy as np
import panda_gym
import pytest
import torch
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import SubprocVecEnv
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import DDPGLoss

import torch_panda
from tests.learning.transitions import make_transitions
from torch_panda.gymnasium_envs.sb3 import SB3VecEnv
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.agents.base import LEARNING_RATE, TAU
from torch_panda.learning.buffers import BUFFER_SIZE
from torch_panda.learning.networks import HIDDEN_SIZE
from torch_panda.learning.normalizer import CLIP_NORMALIZED
from torch_panda.learning.options import Args, default_args
from torch_panda.learning.training import Run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]
EPISODES = 80
ROUNDS = 100


class PlainDDPG:
    """The arithmetic of our gradient step in plain torch, of networks of its own."""

    def __init__(self, batch, gamma):
        self.batch, self.gamma = batch, gamma
        states = batch["observation"].shape[-1] + batch["desired_goal"].shape[-1]
        actions = batch["action"].shape[-1]
        self.mean, self.std = torch.zeros(states), torch.ones(states)
        self.actor = self.mlp(states, actions, nn.Tanh())
        self.critic = self.mlp(states + actions, 1)
        nets = nn.ModuleList([self.actor, self.critic])
        self.targets = copy.deepcopy(nets).requires_grad_(False)
        self.online, self.target = list(nets.parameters()), [*self.targets.parameters()]
        self.optimizer = torch.optim.Adam(self.online, lr=LEARNING_RATE, fused=True)

    @staticmethod
    def mlp(inputs, outputs, *last):
        sizes = [inputs] + [HIDDEN_SIZE] * 3
        layers = [
            layer
            for n, m in itertools.pairwise(sizes)
            for layer in (nn.Linear(n, m), nn.ReLU())
        ]
        return nn.Sequential(*layers, nn.Linear(HIDDEN_SIZE, outputs), *last)

    def normalize(self, observation, goal):
        state = (torch.cat((observation, goal), -1) - self.mean) / self.std
        return state.clamp(-CLIP_NORMALIZED, CLIP_NORMALIZED)

    def states(self):
        batch, after = self.batch, self.batch["next"]
        goal = batch["desired_goal"]
        return (
            self.normalize(batch["observation"], goal),
            self.normalize(after["observation"], goal),
        )

    def descend(self):
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(self.target, self.online, TAU)

    def update(self):
        batch, after, (actor, critic) = self.batch, self.batch["next"], self.targets
        state, next_state = self.states()
        with torch.no_grad():
            value = critic(torch.cat((next_state, actor(next_state)), -1))
            target = after["reward"] + self.gamma * value * ~after["terminated"]
            target = target.clamp(-1 / (1 - self.gamma), 0)
        value = self.critic(torch.cat((state, batch["action"]), -1))
        self.optimizer.zero_grad()
        (value - target).square().mean().backward()
        action = self.actor(state)
        value = self.critic(torch.cat((state, action), -1))
        loss = action.square().mean() - value.mean()
        loss.backward(inputs=list(self.actor.parameters()))
        self.descend()


class OverTorchRL(PlainDDPG):
    """The same over torchrl's DDPGLoss."""

    def __init__(self, batch, gamma):
        super().__init__(batch, gamma)
        keys = ["normalized"], ["action"], ["state_action_value"]
        actor = TensorDictModule(self.actor, keys[0], keys[1])
        concatenate = Concatenate(self.critic)
        critic = TensorDictModule(concatenate, keys[0] + keys[1], keys[2])
        self.loss = DDPGLoss(actor, critic, delay_actor=True, loss_function="l2")
        self.loss.make_value_estimator(gamma=gamma)
        self.online = list(self.loss.parameters())
        parts = ("target_actor_network_params", "target_value_network_params")
        self.target = [
            x for part in parts for x in getattr(self.loss, part).values(True, True)
        ]
        own = ("actor_network_params", "value_network_params")
        self.online = [
            x for part in own for x in getattr(self.loss, part).values(True, True)
        ]
        self.optimizer = torch.optim.Adam(self.online, lr=LEARNING_RATE, fused=True)

    def update(self):
        batch = self.batch.copy()
        batch["normalized"], batch["next", "normalized"] = self.states()
        losses = self.loss(batch)
        self.optimizer.zero_grad()
        (losses["loss_value"] + losses["loss_actor"]).backward()
        self.descend()


class Concatenate(nn.Module):
    """A critic of two inputs."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, state, action):
        return self.net(torch.cat((state, action), -1))


def test_a_gradient_step_costs_little_more_than_its_arithmetic():
    """Of DDPG on 256 rows that are sampled already, in turns, on one thread."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with torch_panda.make("PandaPush-v1", num_envs=2) as env:
        agent = make_agent(env, Hyperparameters())
        batch = make_transitions(env, 256)
    ways = {
        "plain torch": PlainDDPG(batch, agent.gamma).update,
        "ours": lambda: agent.update(batch),
        "over torchrl's DDPGLoss": OverTorchRL(batch, agent.gamma).update,
    }
    taken = {name: [] for name in ways}
    for _ in range(ROUNDS):
        for name, update in ways.items():
            started = time.perf_counter()
            for _ in range(5):
                update()
            taken[name].append((time.perf_counter() - started) / 5)
    print()
    ratios = {}
    for name, times in taken.items():
        pairs = zip(times, taken["plain torch"], strict=True)
        ratios[name] = statistics.median(ours / plain for ours, plain in pairs)
        milliseconds = 1000 * statistics.median(times)
        print(f"{name}: {milliseconds:.2f} ms, {ratios[name]:.2f} times plain torch")
    assert ratios["ours"] <= 1.15


@dataclass
class Case:
    """What is learned, and when it counts as learned."""

    task: str
    args: Args
    goal: float
    """success of an evaluation that ends the run"""
    seeds: int
    patience: float
    """times our time after which Stable-Baselines3 is stopped"""

    @property
    def env_id(self):
        return f"Panda{self.task}-v3"


REACH = Case("Reach", Args(eval_interval=500), goal=1.0, seeds=3, patience=10)
TUNED = replace(default_args("tuned", "PandaPush-v3"), total_steps=200_000)
PUSH = Case("Push", TUNED, goal=0.95, seeds=1, patience=2.5)


def make_gym_env(task):
    # Names the module, whose import in the worker process registers the id.
    return gymnasium.make(f"Panda{task}-v{panda_gym.__version__[0]}")


class Learned:
    """A stop signal: true once an evaluation was good enough."""

    def __init__(self, run, goal):
        self.run, self.goal = run, goal

    def __bool__(self):
        return self.run.progress.curve[-1]["success"] >= self.goal


class Evaluations(BaseCallback):
    """The same for Stable-Baselines3, evaluated in our environments.

    It stops after `patience` seconds, too: so much longer is enough to know.
    """

    def __init__(self, case, patience):
        super().__init__()
        self.case, self.patience = case, patience
        self.env = SB3VecEnv(case.env_id, num_envs=16)
        self.evaluating, self.learned, self.last = 0.0, None, 0.0

    def _on_training_start(self):
        self.started = time.perf_counter()

    def _on_step(self):
        if self.num_timesteps % self.case.args.eval_interval:
            return True
        now = time.perf_counter()
        learning = now - self.started - self.evaluating
        self.last = self.success()
        if self.last >= self.case.goal:
            self.learned = self.num_timesteps, learning
        self.evaluating += time.perf_counter() - now
        return self.learned is None and learning < self.patience

    def success(self):
        outcomes, observation = [], self.env.reset()
        while len(outcomes) < EPISODES:
            action, _ = self.model.predict(observation, deterministic=True)
            observation, _, dones, infos = self.env.step(action)
            outcomes += [infos[i]["is_success"] for i in np.flatnonzero(dones)]
        return np.mean(outcomes)


def learn_ours(case, folder, seed):
    run = Run(replace(case.args, env_id=case.env_id, seed=seed), folder)
    run.train(stop=Learned(run, case.goal))
    run.close()
    last = run.progress.curve[-1]
    return (last["step"], last["seconds"]) if last["success"] >= case.goal else None


def learn_sb3(case, seed, patience):
    args = case.args
    env = SubprocVecEnv([partial(make_gym_env, case.task)] * args.num_envs)
    model = DDPG(
        "MultiInputPolicy",
        env,
        learning_rate=LEARNING_RATE,
        buffer_size=BUFFER_SIZE,
        learning_starts=50 * args.num_envs,
        batch_size=args.batch_size,
        tau=TAU,
        gamma=args.gamma or 0.98,
        train_freq=1,
        gradient_steps=int(args.updates_per_step * args.num_envs),
        action_noise=NormalActionNoise(np.zeros(3), np.full(3, args.noise_eps)),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4},
        policy_kwargs={"net_arch": [HIDDEN_SIZE] * 3},
        seed=seed,
    )
    evaluations = Evaluations(case, patience)
    model.learn(1_000_000, evaluations)
    env.close()
    evaluations.env.close()
    print(f"SB3: success {evaluations.last:.0%} after {model.num_timesteps} steps")
    return evaluations.learned or (model.num_timesteps, None)


@pytest.mark.parametrize("case", [REACH, PUSH], ids=["reach", "push"])
def test_half_the_time_of_stable_baselines3(tmp_path, case):
    """Same networks, batches and updates a step, one torch thread."""
    torch.set_num_threads(1)
    ratios = []
    for seed in range(case.seeds):
        (tmp_path / str(seed)).mkdir()
        ours = learn_ours(case, tmp_path / str(seed), seed)
        assert ours is not None
        theirs = learn_sb3(case, seed, patience=case.patience * ours[1])
        print(f"seed {seed}: (steps, s) to {case.goal:.0%}: ours {ours}, SB3 {theirs}")
        ratios.append(ours[1] / (theirs[1] or case.patience * ours[1]))
    print("share of its time, at most:", ratios)
    assert sorted(ratios)[len(ratios) // 2] <= 0.5
