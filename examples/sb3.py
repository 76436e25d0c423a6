"""Stable-Baselines3: SAC with its own HerReplayBuffer on our environments.

python examples/sb3.py
"""

import numpy as np
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.vec_env import VecMonitor

from torch_panda.gymnasium_envs.sb3 import SB3VecEnv

NUM_ENVS = 8
TOTAL_STEPS = 6_000
EPISODES = 50  # of the evaluation


def make_env(seed: int, num_envs: int) -> VecMonitor:
    """Environments for SB3, which are stepped in threads instead of processes.

    `VecMonitor` gives SB3 the returns and lengths of the episodes that it logs.
    """
    return VecMonitor(SB3VecEnv("PandaReach-v1", num_envs=num_envs, seed=seed))


def evaluate(model: SAC) -> float:
    """Share of episodes that end in success when the policy acts without noise."""
    env = make_env(seed=1, num_envs=EPISODES)
    observation, dones = env.reset(), np.zeros(EPISODES, dtype=bool)
    while not dones.any():  # all episodes of -v1 last 50 steps
        action, _ = model.predict(observation, deterministic=True)
        observation, _, dones, infos = env.step(action)
    env.close()
    return float(np.mean([info["is_success"] for info in infos]))


def main() -> float:
    """Train, and return the success of the evaluation."""
    env = make_env(seed=0, num_envs=NUM_ENVS)
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        # Four relabelled rows for each original one, as `her_ratio=0.8` here.
        replay_buffer_kwargs={"n_sampled_goal": 4},
        learning_starts=50 * NUM_ENVS,  # HER needs whole episodes
        gradient_steps=NUM_ENVS // 2,  # per step of all environments
        gamma=0.95,
        learning_rate=1e-3,
        seed=0,
        verbose=1,
    )
    model.learn(TOTAL_STEPS)
    env.close()
    success = evaluate(model)
    print(
        f"{TOTAL_STEPS} steps: success at the end of {EPISODES} episodes {success:.0%}"
    )
    return success


if __name__ == "__main__":
    main()
