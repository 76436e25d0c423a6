"""The packed solver in forked children and in many clients."""

import multiprocessing
import random

import torch

import torch_panda
from tests.solver.solvers import needs_packed, solver
from tests.solver.test_scenes import World
from torch_panda.bullet.solver import activate

pytestmark = needs_packed
N = 2


def make():
    return torch_panda.make("PandaPickAndPlace-v1", num_envs=N, num_threads=2, seed=5)


def steps(env, count=15):
    """Observations of steps that press the hand on the table."""
    generator, td, observed = torch.Generator().manual_seed(1), env.reset(), []
    for _ in range(count):
        action = torch.rand(env.action_spec.shape, generator=generator) * 2 - 1
        action[:, 2] -= 0.5
        td = env.step(td.set("action", action))["next"].exclude("reward")
        observed.append(td["observation"])
    return torch.stack(observed).tolist()


def reference():
    with (
        solver("bullet"),
        torch_panda.make(
            "PandaPickAndPlace-v1", num_envs=N, num_threads=1, seed=5
        ) as env,
    ):
        return steps(env)


def test_a_forked_child_steps_with_the_packed_solver():
    expected = reference()
    env = make()
    assert steps(env) == expected
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def child():
        env.set_seed(5)
        inherited = steps(env)  # clients of the parent
        with make() as own:  # a client of the child
            sender.send((activate().name, inherited, steps(own)))

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    try:
        assert receiver.poll(120)
        name, inherited, own = receiver.recv()
        process.join(60)
    finally:
        process.kill()
    assert name == "packed"
    assert inherited == own == expected
    env.set_seed(5)
    assert steps(env) == expected  # the parent goes on
    env.close()


def pile():
    world = World()
    world.ground()
    for k in range(4):
        world.box(0.5, (0.01 * k, 0, 0.06 + 0.11 * k))
    world.chain(3, (0.02, 0.02, 0.9))
    return world


def test_64_clients_created_and_closed_at_random_step_alike():
    with solver("bullet"):
        world, expected = pile(), []
        for k in range(60):
            world.step(k)
            expected.append(world.state())
    with solver("packed") as library:
        rng = random.Random(0)
        open_worlds, num_created, num_finished = [], 0, 0
        while num_created < 64 or open_worlds:
            if num_created < 64 and len(open_worlds) < 12 and rng.random() < 0.3:
                open_worlds.append([pile(), 0])
                num_created += 1
            if not open_worlds:
                continue
            index = rng.randrange(len(open_worlds))
            world, age = open_worlds[index]
            world.step(age)
            assert world.state() == expected[age]
            open_worlds[index][1] += 1
            if age + 1 == len(expected) or rng.random() < 0.02:
                open_worlds.pop(index)[0].client.disconnect()
                num_finished += age + 1 == len(expected)
        counts = library.counts()
    assert num_finished >= 5
    assert counts.groups > 0
    assert counts.manifolds > 0
