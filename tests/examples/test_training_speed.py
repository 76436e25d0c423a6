"""Time to learn Reach beside Stable-Baselines3: pytest -m slow -s <this file>."""

import time
from dataclasses import replace

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
from train import PRESETS, Run

pytestmark = pytest.mark.slow
ID = "PandaReach-v3"
NUM_ENVS, INTERVAL, MOST_STEPS, EPISODES = 4, 500, 10_000, 80
PAPER = PRESETS["paper"]


def make_gym_env():
    # Names the module, whose import in the worker process registers the id.
    return gymnasium.make(f"PandaReach-v{panda_gym.__version__[0]}")


class OurRun(Run):
    """Stops when an evaluation is perfect; what evaluations take is not counted."""

    evaluating, learned = 0.0, None

    def evaluate(self):
        learning = self.seconds - self.evaluating
        started = time.perf_counter()
        super().evaluate()
        self.evaluating += time.perf_counter() - started
        if self.learned is None and self.curve[-1]["success"] == 1.0:
            self.learned = self.steps, learning
            self.args.total_steps = self.steps  # ends the run


class Evaluations(BaseCallback):
    """The same for Stable-Baselines3, evaluated in our environments."""

    def __init__(self):
        super().__init__()
        self.env = SB3VecEnv(ID, num_envs=16)
        self.evaluating, self.learned = 0.0, None

    def _on_training_start(self):
        self.started = time.perf_counter()

    def _on_step(self):
        if self.num_timesteps % INTERVAL:
            return True
        now = time.perf_counter()
        if self.success() == 1.0:
            self.learned = self.num_timesteps, now - self.started - self.evaluating
        self.evaluating += time.perf_counter() - now
        return self.learned is None

    def success(self):
        outcomes, observation = [], self.env.reset()
        while len(outcomes) < EPISODES:
            action, _ = self.model.predict(observation, deterministic=True)
            observation, _, dones, infos = self.env.step(action)
            outcomes += [infos[i]["is_success"] for i in np.flatnonzero(dones)]
        return np.mean(outcomes)


def learn_ours(folder, seed):
    args = replace(
        PAPER, env_id=ID, seed=seed, total_steps=MOST_STEPS, eval_interval=INTERVAL
    )
    run = OurRun(args, folder)
    run.train()
    run.close()
    return run.learned


def learn_sb3(seed):
    env = SubprocVecEnv([make_gym_env] * NUM_ENVS)
    model = DDPG(
        "MultiInputPolicy",
        env,
        learning_rate=PAPER.learning_rate,
        buffer_size=PAPER.buffer_size,
        learning_starts=50 * NUM_ENVS,
        batch_size=PAPER.batch_size,
        tau=PAPER.tau,
        gamma=0.98,
        train_freq=1,
        gradient_steps=int(PAPER.updates_per_step * NUM_ENVS),
        action_noise=NormalActionNoise(np.zeros(3), np.full(3, PAPER.noise_eps)),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4},
        policy_kwargs={"net_arch": [PAPER.hidden_size] * 3},
        seed=seed,
    )
    evaluations = Evaluations()
    model.learn(MOST_STEPS, evaluations)
    env.close()
    evaluations.env.close()
    return evaluations.learned


def test_reach_in_half_the_time_of_stable_baselines3(tmp_path):
    """Same networks, batches and updates a step, one torch thread, three seeds."""
    torch.set_num_threads(1)
    ratios = []
    for seed in range(3):
        (tmp_path / str(seed)).mkdir()
        ours, theirs = learn_ours(tmp_path / str(seed), seed), learn_sb3(seed)
        print(f"seed {seed}: (steps, s) to 100 %: ours {ours}, SB3 {theirs}")
        assert ours is not None
        ratios.append(0.0 if theirs is None else ours[1] / theirs[1])
    print("share of its time:", ratios)
    assert sorted(ratios)[1] <= 0.5
