"""Divergence is noticed and named, and the environment starts its next episode."""

from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict

import torch_panda
from torch_panda.sensors import Entry, Sensor


def make(on_divergence, **options):
    return torch_panda.make(
        "PandaPush-v1",
        num_envs=3,
        num_threads=2,
        seed=0,
        on_divergence=on_divergence,
        **options,
    )


def blow_up(env, index, body):
    """Give a body a velocity whose square overflows, behind the environment's back."""
    simulation = env.episodes.simulation
    client, scene = simulation.clients[index], simulation.scene
    if body == "object":
        (cube,) = scene.objects
        client.set_base(cube, (0, 0, 0.02), (0, 0, 0, 1), (1e300, 0, 0), (0, 0, 0))
    else:
        client.set_joint(scene.robot, scene.joints[1], 0.4, 1e300)


def step(env):
    return env.step(TensorDict({"action": torch.zeros(3, 3)}, batch_size=[3]))["next"]


@pytest.mark.parametrize("body", ["object", "robot"])
def test_an_error_names_the_environment_that_diverged(body):
    """It starts its next episode, which the divergence cannot change."""
    with make("raise") as env, make("raise") as other:
        for e in (env, other):
            e.reset()
            step(e)
        blow_up(env, 1, body)
        with pytest.raises(torch_panda.BulletError, match=r"ments \[1\] div"):
            step(env)
        only_1 = torch.tensor([[False], [True], [False]])
        other.reset(step(other).set("_reset", only_1))
        for _ in range(30):
            assert (env.get_state() == other.get_state()).all()
            step(env)
            step(other)


@pytest.mark.parametrize("body", ["object", "robot"])
def test_a_step_that_diverges_leaves_the_other_environments_untouched(body):
    """Bullet itself computes infinite numbers, because a weight of 1e309 N is infinite.

    All environments equal, bit for bit, those of a batch in which nothing diverged,
    except for the step that diverges.
    """
    diverges, only_1 = 4, torch.tensor([[False], [True], [False]])
    generator = torch.Generator().manual_seed(0)
    with make("reset") as env, make("reset") as other:
        ours, theirs = env.reset(), other.reset()
        for step in range(12):
            if step == diverges:
                simulation = env.episodes.simulation
                scene, client = simulation.scene, simulation.clients[1]
                heavy = (scene.objects[0], -1) if body == "object" else (scene.robot, 5)
                client.set_dynamics(*heavy, mass=1.7e308)
            action = torch.rand(3, 3, generator=generator) * 2 - 1
            ours = env.step(ours.set("action", action))["next"]
            theirs = other.step(theirs.set("action", action))["next"]
            alike = [0, 2] if step == diverges else [0, 1, 2]
            for key, value in ours.items():
                assert value.isfinite().all(), key
                assert torch.equal(value[alike], theirs[key][alike]), (key, step)
            assert (env.get_state()[alike] == other.get_state()[alike]).all()
            assert ours["truncated"].flatten().tolist() == [
                False,
                step == diverges,
                False,
            ]
            if step == diverges:
                assert ours["done"][1] and not ours["success"][1]
                ours = env.reset(ours.set("_reset", only_1)).exclude("_reset")
                # The first of these episodes began after the divergence.
                for _ in range(2):
                    theirs = other.reset(theirs.set("_reset", only_1))
                theirs = theirs.exclude("_reset")


@pytest.mark.parametrize("goal", ["task", "observation"])
def test_the_transition_that_diverges_keeps_its_goal(goal):
    with make("reset", goal=goal) as env:
        start = env.reset()
        step(env)
        blow_up(env, 1, "object")
        following = step(env)
        assert following["truncated"].flatten().tolist() == [False, True, False]
        assert torch.equal(following["desired_goal"], start["desired_goal"])
        reward = env.compute_reward(following["achieved_goal"], start["desired_goal"])
        assert torch.equal(following["reward"], reward)
        only_1 = torch.tensor([[False], [True], [False]])
        new = env.reset(following.set("_reset", only_1))
        is_new = (new["desired_goal"] != start["desired_goal"]).any(1)
        assert is_new.tolist() == [False, True, False]


class Steps(Sensor):
    """Counts the steps of each episode."""

    entries: ClassVar = {"steps": Entry((1,), torch.float32)}

    def attach(self, simulation, renderer, robot):
        self._count = torch.zeros(simulation.num_envs, 1)
        return self

    def after_reset(self, envs):
        self._count[list(envs)] = 0

    def after_step(self, envs):
        self._count[list(envs)] += 1

    def observe(self):
        return {"steps": self._count.clone()}


def test_a_divergence_is_no_step_of_a_sensors_next_episode():
    with make("reset", sensors=(Steps(),)) as env:
        env.reset()
        step(env)
        blow_up(env, 1, "object")
        assert step(env)["steps"].flatten().tolist() == [2, 0, 2]


def test_a_step_returns_the_stepped_clients_that_diverged():
    with make("raise") as env:
        env.reset()
        simulation, control = env.episodes.simulation, env.robot.controller
        setpoint = env.robot.setpoint(torch.zeros(3, 3), simulation).numpy()
        blow_up(env, 0, "object")
        blow_up(env, 1, "object")
        assert simulation.step(control, setpoint, [1]) == [1]
        assert simulation.step(control, setpoint, [0, 2]) == [0]


def test_states_that_would_diverge_are_refused():
    with make("raise") as env:
        env.reset()
        state = env.get_state()
        state["object_velocity"][2, 0, 0] = 1e300
        with pytest.raises(ValueError, match=r"object_velocity of environment 2 .* 1e"):
            env.reset(state, set_state=True)
