"""Environments for spawned workers, which report their numbers of threads."""

import torch
from torchrl.data import Unbounded
from torchrl.envs import Transform, TransformedEnv

import torch_panda

NUM_ENVS = 2  # per worker


class ReportThreads(Transform):
    """Adds the number of threads that step the environments, and that of torch."""

    def _report(self, tensordict):
        stepping = self.parent.base_env.num_threads
        report = torch.tensor([stepping, torch.get_num_threads()])
        return tensordict.set("threads", report.repeat(*tensordict.batch_size, 1))

    def _step(self, tensordict, next_tensordict):
        return self._report(next_tensordict)

    def _reset(self, tensordict, tensordict_reset):
        return self._report(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        shape = (*observation_spec.shape, 2)
        observation_spec["threads"] = Unbounded(shape, dtype=torch.int64)
        return observation_spec


def make_env():
    env = torch_panda.make("PandaReach-v1", num_envs=NUM_ENVS, num_threads=2)
    return TransformedEnv(env, ReportThreads())


def go_for_the_goal(tensordict):
    """A deterministic policy."""
    towards = tensordict["desired_goal"] - tensordict["achieved_goal"]
    return tensordict.set("action", (5 * towards).clamp(-1, 1))
