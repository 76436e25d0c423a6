"""torchrl's own transforms, batched environments and collectors, as they stand."""

import functools

import pytest
import torch
from torchrl.collectors import Collector, MultiAsyncCollector
from torchrl.envs import (
    CatTensors,
    Compose,
    InitTracker,
    ObservationNorm,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import RandomPolicy

import torch_panda

make_env = functools.partial(
    torch_panda.make, "PandaReach-v1", num_envs=2, num_threads=1
)


def test_transforms():
    env = TransformedEnv(
        make_env(seed=0),
        Compose(
            StepCounter(),
            RewardSum(),
            InitTracker(),
            CatTensors(["observation", "desired_goal"], "inputs", del_keys=False),
            ObservationNorm(in_keys=["inputs"], out_keys=["inputs"]),
        ),
    )
    env.transform[-1].init_stats(100, reduce_dim=(0, 1), cat_dim=1)
    rollout = env.rollout(60, break_when_any_done=False)
    env.close()
    assert rollout["inputs"].shape == (2, 60, 9)
    assert rollout["inputs"].mean().abs() < 1.0
    assert rollout["is_init"][:, :, 0].nonzero()[:, 1].tolist() == [0, 50, 0, 50]
    assert rollout["next", "step_count"].max() == 50
    total = rollout["next", "reward"][:, :50].sum(1)
    torch.testing.assert_close(rollout["next", "episode_reward"][:, 49], total)


def test_transformed_environments_do_not_lose_a_state_silently():
    with make_env(seed=0) as env:
        env.rollout(5)
        state = env.get_state()
        transformed = TransformedEnv(env, StepCounter())
        with pytest.raises(ValueError, match="do not pass states on"):
            transformed.reset(state, set_state=True)
        start = transformed.base_env.reset(state, set_state=True)
        assert (start.select(*state.keys()) == state).exclude("desired_goal").all()


def test_batched_environments():
    """In one process; `test_multi_process` compares it with a ParallelEnv."""
    env = SerialEnv(2, make_env)
    env.set_seed(0)
    rollout = env.rollout(5)
    env.close()
    assert rollout.batch_size == (2, 2, 5)
    # Workers draw different goals.
    assert len(rollout["desired_goal"][:, :, 0].reshape(4, 3).unique(dim=0)) == 4


def test_collector():
    collector = Collector(
        make_env(seed=0), RandomPolicy(make_env().action_spec), frames_per_batch=120
    )
    data = next(iter(collector))
    collector.shutdown()
    assert data.batch_size == (2, 60)
    assert data["next", "truncated"][:, 49].all()
    ids = data["collector", "traj_ids"]
    assert (ids[:, 50] != ids[:, 49]).all()


def test_multi_process_collector():
    """The asynchronous one; `test_multi_process` has the other."""
    collector = MultiAsyncCollector(
        [make_env, make_env],
        RandomPolicy(make_env().action_spec),
        frames_per_batch=80,
        total_frames=160,
    )
    collector.set_seed(0)
    batches = [data.clone() for data in collector]
    collector.shutdown()
    goals = torch.cat([b["desired_goal"].reshape(-1, 3) for b in batches])
    assert sum(b.numel() for b in batches) == 160
    # Two workers of two environments: four goals that differ.
    assert len(goals.unique(dim=0)) == 4
