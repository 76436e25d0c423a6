"""A small batched environment whose goals say where they are from."""

import functools

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, ParallelEnv


class ToyEnv(EnvBase):
    """Environment i of worker w achieves (worker and i, episode, step) at each step."""

    def __init__(self, num_envs: int = 3, worker: int = 0) -> None:
        super().__init__(batch_size=[num_envs])
        shape = (num_envs,)
        goal = Unbounded((*shape, 3))
        self.observation_spec = Composite(
            achieved_goal=goal, desired_goal=goal.clone(), shape=shape
        )
        self.action_spec = Bounded(-1, 1, (*shape, 2))
        self.reward_spec = Unbounded((*shape, 1))
        self.who = torch.arange(num_envs) + 100 * worker
        self.episode = torch.full(shape, -1)
        self.time = torch.zeros(shape, dtype=torch.int64)

    def _observe(self) -> TensorDict:
        goal = torch.stack([self.who, self.episode, self.time], -1).float()
        none = torch.full_like(goal, -1.0)
        return TensorDict(
            {"achieved_goal": goal, "desired_goal": none}, self.batch_size
        )

    def _reset(self, tensordict: TensorDict | None, **kwargs: object) -> TensorDict:
        mask = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            mask = tensordict["_reset"].view(self.batch_size)
        self.episode = self.episode + mask
        self.time = torch.where(mask, 0, self.time)
        return self._observe()

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.time = self.time + 1
        # Lengths differ from episode to episode and from environment to environment.
        done = (self.time >= 3 + (self.who + 5 * self.episode) % 11)[:, None]
        result = self._observe()
        result["reward"] = torch.full((*self.batch_size, 1), -7.0)
        result["done"] = done
        result["terminated"] = torch.zeros_like(done)
        result["truncated"] = done.clone()
        return result

    def _set_seed(self, seed: int | None) -> None:
        pass


def make_env(worker: int = 0) -> ToyEnv:
    return ToyEnv(3, worker)


make_first = functools.partial(make_env, 1)
make_second = functools.partial(make_env, 2)


def make_parallel() -> ParallelEnv:
    return ParallelEnv(2, [make_first, make_second])
