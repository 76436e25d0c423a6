"""Judge a policy in panda-gym's own environments, with panda-gym's own seeds.

    python examples/panda_gym_judge.py PandaPush-v3 --episodes 1000
    python examples/panda_gym_judge.py runs/PandaPush-v3-ddpg-relabel-0

It needs panda-gym 3.0.7, which comes with the extra `test`. Episode i begins with
`env.reset(seed=seed + i)`, and ends with success or after panda-gym's time limit.
"""

from typing import Annotated

import gymnasium
import panda_gym
import torch
import tyro
from panda_gym.envs import panda_tasks
from panda_gym.pybullet import PyBullet
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torch_panda
from torch_panda.learning.evaluation import Evaluation

OBSERVED = ("observation", "achieved_goal", "desired_goal")


class WithoutTextures(PyBullet):
    """panda-gym's wheel misses the texture of Flip's cube; physics does not need it."""

    def create_box(self, body_name: str, *args: object, **kwargs: object) -> None:
        """Create a box without a texture."""
        super().create_box(body_name, *args, **{**kwargs, "texture": None})


@torch.no_grad()
@set_exploration_type(ExplorationType.DETERMINISTIC)
def judge(policy_name: str, env_id: str, episodes: int, seed: int) -> Evaluation:
    """Play episodes of panda-gym with a policy of `torch_panda.load_policy`."""
    policy = torch_panda.load_policy(policy_name)
    flags, returns, lengths = [], [], []
    panda_tasks.PyBullet = WithoutTextures
    env = gymnasium.make(env_id)
    for episode in range(episodes):
        state, info = env.reset(seed=seed + episode)
        task = env.unwrapped.get_wrapper_attr("task")
        success = [bool(task.is_success(state["achieved_goal"], state["desired_goal"]))]
        rewards, done = [], False
        while not done:
            td = TensorDict({key: torch.as_tensor(state[key]) for key in OBSERVED})
            action = policy(td)["action"].numpy()
            state, reward, terminated, truncated, info = env.step(action)
            success.append(bool(info["is_success"]))
            rewards.append(float(reward))
            done = terminated or truncated
        flags.append((success[-1], any(success[1:]), success[0]))
        returns.append(sum(rewards))
        lengths.append(len(rewards))
    env.close()
    at_end, ever, at_start = torch.tensor(flags).unbind(1)
    return Evaluation(
        success=at_end,
        ever=ever,
        at_start=at_start,
        returns=torch.tensor(returns),
        lengths=torch.tensor(lengths),
    )


def main(
    policy: Annotated[str, tyro.conf.Positional],
    env_id: str | None = None,
    episodes: int = 100,
    seed: int = 0,
) -> Evaluation:
    """Judge a policy in panda-gym.

    Args:
        policy: id whose policy torch_panda ships, folder of a run, or its checkpoint.pt
        env_id: id of panda-gym, such as PandaPush-v3; None means that of the policy
        episodes: number of episodes
        seed: seed of the first episode; the others count on from it
    """
    env_id = env_id or torch_panda.load_policy(policy).env_id
    result = judge(policy, env_id, episodes, seed)
    low, high = result.interval
    print(f"{env_id} of panda-gym {panda_gym.__version__}, {episodes} episodes")
    print(f"success at the end   {result.success_rate:6.1%}  [{low:.1%}, {high:.1%}]")
    print(f"return               {result.mean_return:6.2f}")
    print(f"steps                {result.mean_length:6.1f}")
    return result


if __name__ == "__main__":
    tyro.cli(main)
