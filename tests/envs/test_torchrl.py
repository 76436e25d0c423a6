"""torchrl's own transforms and batched environments work."""

import functools
from contextlib import suppress

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import (
    CatTensors,
    Compose,
    InitTracker,
    ObservationNorm,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TensorDictPrimer,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda.envs import StateTransform

make_env = functools.partial(
    torch_panda.make, "PandaReach-v1", num_envs=2, num_threads=1
)


def test_torchrls_transforms_see_the_episodes():
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


def make_counted():
    return TransformedEnv(make_env(seed=0), StepCounter())


def make_primed():
    primer = TensorDictPrimer(hidden=Unbounded((4,)), expand_specs=True)
    return TransformedEnv(make_env(seed=0), primer)


def make_with_state():
    transforms = Compose(StateTransform(), StepCounter())
    return TransformedEnv(make_env(seed=0), transforms)


@pytest.mark.parametrize("make_worker", [make_counted, make_primed])
def test_a_reset_with_entries_of_transforms_is_a_new_episode(make_worker):
    """torchrl takes them for a state, because the transforms name them in specs."""
    env = SerialEnv(2, make_worker)
    first = env.rollout(3)[..., -1]
    start = env.reset(first.clone())
    assert not torch.equal(start["desired_goal"], first["desired_goal"])
    if make_worker is make_counted:
        only_count = TensorDict({"step_count": first["step_count"]}, [2, 2])
        assert not env.reset(only_count)["step_count"].any()
    env.close()


def test_a_state_transform_passes_states_on():
    env = make_with_state()
    check_env_specs(env)
    rollout = env.rollout(8)
    now = rollout[..., 5]
    # The state has its own step count. That of StepCounter starts at zero again.
    assert torch.equal(now["state", "step_count"], now["step_count"])
    start = env.reset(now.select("state"), set_state=True)
    assert (start["state"] == now["state"]).all()
    assert not start["step_count"].any()
    assert torch.equal(start["desired_goal"], now["desired_goal"])
    again = env.reset(now.select("state"))  # as from torchrl 0.15 on
    assert not torch.equal(again["desired_goal"], now["desired_goal"])
    env.close()


WRAPPERS_THAT_DROP_STATES = {
    "transformed": make_counted,
    "transformed, with another state": make_with_state,
    "different serial workers": lambda: SerialEnv(2, [make_counted, make_primed]),
    "parallel workers": lambda: ParallelEnv(2, make_counted),
    "parallel workers, with another state": lambda: ParallelEnv(2, make_with_state),
}


@pytest.mark.parametrize("name", WRAPPERS_THAT_DROP_STATES)
def test_a_state_that_would_not_arrive_is_refused(name):
    with make_env(seed=0) as env:
        env.rollout(5)
        state = env.get_state()
    wrapped = WRAPPERS_THAT_DROP_STATES[name]()
    if wrapped.ndim == 2:
        state = torch.stack([state, state])
    # torchrl itself refuses, unless there is a StateTransform.
    with pytest.raises((NotImplementedError, ValueError, RuntimeError)):
        wrapped.reset(state.clone(), set_state=True)
    with suppress(RuntimeError):  # a worker that raised has ended
        wrapped.close(raise_if_closed=False)


def test_serial_workers_start_from_a_state_if_they_are_told_to():
    env = SerialEnv(2, make_env)
    env.rollout(5)
    state = torch.stack([worker.get_state() for worker in env._envs])
    for set_state in (None, False, True):
        start = env.reset(state.clone(), set_state=set_state)
        reached = torch.equal(start["desired_goal"], state["desired_goal"].float())
        assert reached == bool(set_state)
    env.close()


@pytest.mark.parametrize("batched_env", [SerialEnv, ParallelEnv])
def test_a_state_transform_passes_states_to_workers(batched_env):
    env = batched_env(2, make_with_state)
    last = env.rollout(4)[..., -1]
    start = env.reset(last.select("state"), set_state=True)
    for key in ("object_pose", "joint_position", "desired_goal", "step_count"):
        assert torch.equal(start["state", key], last["state", key])
    env.close()


def test_a_bare_environment_takes_a_nested_state():
    with make_env(seed=0) as env:
        env.rollout(3)
        state = env.get_state()
        expected = env.reset(state, set_state=True)
        nested = TensorDict({"state": state}, [2])
        for set_state in (True, None):
            start = env.reset(nested, set_state=set_state)
            assert (
                start.select(*expected.keys(), strict=False)
                == expected.select(*start.keys(), strict=False)
            ).all()
        observed = start.set("state", state)
        with pytest.raises(ValueError, match="pass set_state=True"):
            env.reset(observed)


def test_an_observation_named_state_is_no_state():
    class Observing(torch_panda.Reach):
        def extra_observation(self, simulation):
            return {"state": simulation.joint_position}

    robot = torch_panda.Panda(block_gripper=True)
    with torch_panda.RobotTaskEnv(robot=robot, task=Observing(), num_envs=2) as env:
        start = env.reset()
        again = env.reset(start.clone())
        assert not torch.equal(start["desired_goal"], again["desired_goal"])
        env.reset(start.clone().update(env.get_state()), set_state=True)
        with pytest.raises(ValueError, match="'state' that Observing or a sensor"):
            TransformedEnv(env, StateTransform()).reset()


def test_a_state_transform_wraps_one_environment():
    env = TransformedEnv(SerialEnv(2, make_env), StateTransform())
    with pytest.raises(TypeError, match="must wrap a RobotTaskEnv, got SerialEnv"):
        env.reset()
    env.close()
