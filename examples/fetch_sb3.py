"""Stable-Baselines3 on FetchPush, to compare steps and minutes with `train`.

python examples/fetch_sb3.py OUT.csv          # DDPG and HER, sizes as in our recipe
python examples/fetch_sb3.py OUT.csv --zoo    # TQC and HER, options of RL Zoo

It needs the extra `fetch`, stable-baselines3 and sb3-contrib. It writes the success in
80 episodes after every 4,000 steps.
"""

import argparse
import csv
import time
from pathlib import Path

import gymnasium
import gymnasium_robotics
import numpy as np
from sb3_contrib import TQC
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

EVAL_INTERVAL, EPISODES = 4_000, 80
HER = {"replay_buffer_class": HerReplayBuffer, "gamma": 0.95, "learning_rate": 1e-3}


def make_model(env: gymnasium.Env, *, zoo: bool, seed: int) -> OffPolicyAlgorithm:
    """DDPG with the sizes of our recipe, or TQC with RL Zoo's options for FetchPush.

    They are those of the file hyperparams/tqc.yml in DLR-RM/rl-baselines3-zoo.
    """
    if zoo:
        policy = {"net_arch": [512] * 3, "n_critics": 2}
        options = {**HER, "policy_kwargs": policy, "batch_size": 2048, "tau": 0.05}
        return TQC("MultiInputPolicy", env, seed=seed, **options)
    noise = NormalActionNoise(np.zeros(4), np.full(4, 0.2))
    options = {**HER, "policy_kwargs": {"net_arch": [256] * 3}, "batch_size": 256}
    options |= {"gradient_steps": 2, "learning_starts": 1_000, "action_noise": noise}
    return DDPG("MultiInputPolicy", env, seed=seed, **options)


def evaluate(model: BaseAlgorithm, env: gymnasium.Env) -> float:
    """Share of episodes that end in success when the policy acts without noise."""
    successes = 0
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=episode)
        is_over = False
        while not is_over:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            is_over = terminated or truncated
        successes += info["is_success"]
    return successes / EPISODES


class Curve(BaseCallback):
    """Writes the success after every `EVAL_INTERVAL` steps, without its own time."""

    def __init__(self, out: Path, minutes: float) -> None:
        super().__init__()
        self.out, self.minutes = out, minutes
        self.env = gymnasium.make("FetchPush-v4")
        self.began, self.evaluating = time.time(), 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps % EVAL_INTERVAL:
            return True
        began = time.time()
        minutes = (began - self.began - self.evaluating) / 60
        row = self.num_timesteps, evaluate(self.model, self.env), round(minutes, 1)
        self.evaluating += time.time() - began
        with self.out.open("a") as file:
            csv.writer(file).writerow(row)
        print(row, flush=True)
        return minutes < self.minutes


def main() -> None:
    """Train for some steps or minutes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--zoo", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-steps", type=int, default=40_000)
    parser.add_argument("--minutes", type=float, default=120)
    args = parser.parse_args()
    gymnasium.register_envs(gymnasium_robotics)
    args.out.write_text("step,success,minutes\n")
    model = make_model(gymnasium.make("FetchPush-v4"), zoo=args.zoo, seed=args.seed)
    model.learn(args.total_steps, Curve(args.out, args.minutes))


if __name__ == "__main__":
    main()
