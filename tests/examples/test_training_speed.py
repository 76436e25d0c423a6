"""Time to learn beside Stable-Baselines3: pytest -m slow -s <this file>."""

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

from torch_panda.gymnasium_envs.sb3 import SB3VecEnv
from train import PRESETS, Args, Run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]
EPISODES = 80


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


PAPER = replace(PRESETS["paper"], total_steps=10_000, eval_interval=500)
TUNED = replace(PRESETS["tuned"], total_steps=200_000, eval_interval=5_000)
REACH = Case("Reach", PAPER, goal=1.0, seeds=3, patience=10)
PUSH = Case("Push", TUNED, goal=0.95, seeds=1, patience=2.5)


def make_gym_env(task):
    # Names the module, whose import in the worker process registers the id.
    return gymnasium.make(f"Panda{task}-v{panda_gym.__version__[0]}")


class OurRun(Run):
    """Stops when it has learned; what evaluations take is not counted."""

    evaluating, learned, goal = 0.0, None, 1.0

    def evaluate(self):
        learning = self.seconds - self.evaluating
        started = time.perf_counter()
        super().evaluate()
        self.evaluating += time.perf_counter() - started
        if self.learned is None and self.curve[-1]["success"] >= self.goal:
            self.learned = self.steps, learning
            self.args.total_steps = self.steps  # ends the run


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
    run = OurRun(replace(case.args, env_id=case.env_id, seed=seed), folder)
    run.goal = case.goal
    run.train()
    run.close()
    return run.learned


def learn_sb3(case, seed, patience):
    args = case.args
    env = SubprocVecEnv([partial(make_gym_env, case.task)] * args.num_envs)
    model = DDPG(
        "MultiInputPolicy",
        env,
        learning_rate=args.learning_rate,
        buffer_size=args.buffer_size,
        learning_starts=50 * args.num_envs,
        batch_size=args.batch_size,
        tau=args.tau,
        gamma=args.gamma or 0.98,
        train_freq=1,
        gradient_steps=int(args.updates_per_step * args.num_envs),
        action_noise=NormalActionNoise(np.zeros(3), np.full(3, args.noise_eps)),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4},
        policy_kwargs={"net_arch": [args.hidden_size] * 3},
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
