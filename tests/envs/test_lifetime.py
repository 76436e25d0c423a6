"""Pickles, resumed runs, and forgotten environments."""

import gc
import pickle
import weakref

import numpy as np
import pytest
import torch
from torchrl.envs import EnvCreator, ParallelEnv

import torch_panda


@pytest.fixture
def no_collection():
    gc.disable()
    yield
    gc.enable()


def test_a_rebound_environment_is_gone_at_once(no_collection):
    """No cycle of references exists, so the garbage collector is not needed."""
    env = torch_panda.make(
        "PandaPush-v1",
        num_envs=2,
        sensors=("wrist_force_torque",),
        depth=True,
        render_size=8,
    )
    env.rollout(3)
    env.render(size=8)
    env.get_state(exact=True)
    connections = [client.connection for client in env.episodes.simulation.clients]
    for renderers in env.episodes.renderer._idle.values():
        connections += [renderer._solids._connection for renderer in renderers]
    assert len(connections) > 2
    reference = weakref.ref(env)
    env = None
    assert reference() is None
    for connection in connections:
        with pytest.raises(torch_panda.BulletError, match="closed"):
            _ = connection.handle


class PushHarder(torch_panda.RobotTaskEnv):
    """A subclass with further arguments."""

    def __init__(self, friction, *, limit=7, **options):
        super().__init__(
            robot=torch_panda.Panda(block_gripper=True),
            task=torch_panda.Push(object_friction=friction),
            max_episode_steps=limit,
            **options,
        )
        self.friction = friction


def test_a_subclass_with_arguments_pickles():
    with PushHarder(0.7, limit=9, num_envs=2) as env:
        env.set_seed(4)
        with pickle.loads(pickle.dumps(env)) as copy:
            assert type(copy) is PushHarder
            assert (copy.friction, copy.max_episode_steps) == (0.7, 9)
            assert copy.task.object_friction == 0.7
            assert (copy.reset() == env.reset()).all()
            # A copy of a copy is the same, too.
            with pickle.loads(pickle.dumps(copy)) as second:
                assert second.friction == 0.7


def test_an_environment_made_in_inference_mode_works_outside_it():
    with torch.inference_mode():
        env = torch_panda.make(
            "PandaPickAndPlace-v1",
            num_envs=2,
            seed=0,
            sensors=("joint_torque",),
            depth=True,
            render_size=8,
        )
        env.rollout(2)
    with env, torch_panda.make("PandaPickAndPlace-v1", num_envs=2, seed=0) as other:
        other.reset()
        start = env.reset()
        assert torch.equal(start["observation"], other.reset()["observation"])
        env.rollout(3)
        env.reset(env.get_state(exact=True), set_state=True)
        # A policy that squashes into the spec's bounds can learn.
        scale = torch.ones(4, requires_grad=True)
        (env.action_spec.high * scale).sum().backward()


def make(**options):
    return torch_panda.make("PandaReach-v1", num_envs=2, num_threads=1, **options)


def test_a_loaded_state_dict_continues_seeds_and_episodes():
    with make(seed=3) as env, make() as resumed:
        env.set_env_seed(1, 8)
        for _ in range(3):
            env.reset()
        env.reset(env.reset().set("_reset", torch.tensor([[True], [False]])))
        state = env.state_dict()
        resumed.load_state_dict(state)
        for _ in range(2):
            assert (env.reset() == resumed.reset()).all()


@pytest.mark.parametrize("seed", [10**30, np.int64(5), torch.tensor(5)])
def test_a_state_dict_is_a_file_without_code(tmp_path, seed):
    with make(seed=seed) as env:
        env.reset()
        torch.save(env.state_dict(), tmp_path / "env.pt")
        state = torch.load(tmp_path / "env.pt", weights_only=True)
        goal = env.reset()["desired_goal"]
        env.load_state_dict(state)
        assert torch.equal(env.reset()["desired_goal"], goal)


def test_environments_of_an_env_creator_have_their_own_seeds():
    creator = EnvCreator(make)
    with creator() as first, creator() as second:
        goals = [env.reset()["desired_goal"] for env in (first, second)]
        assert not torch.equal(*goals)
    workers = ParallelEnv(2, lambda: make())
    goal = workers.reset()["desired_goal"]
    workers.close()
    assert not torch.equal(goal[0], goal[1])
    seeded = EnvCreator(make, create_env_kwargs={"seed": 3})
    with seeded() as env, make(seed=3) as same:
        assert (env.reset() == same.reset()).all()


def test_a_state_dict_of_another_number_of_environments_is_refused():
    with (
        make() as env,
        torch_panda.make("PandaReach-v1", num_envs=3) as other,
        pytest.raises(ValueError, match="holds 2 environments, but this one has 3"),
    ):
        other.load_state_dict(env.state_dict())
