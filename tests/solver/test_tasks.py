"""All tasks with both solvers: equal bits after every step."""

import pytest
import torch

import torch_panda
from tests.ids import PHYSICS_IDS
from tests.solver.solvers import assert_same, needs_packed
from torch_panda.experts import make_expert

pytestmark = needs_packed


def environment(env_id, *, seed=0, expert=False, **options):
    """A scene of `assert_same`: episodes of one environment.

    Args:
        env_id: The environment.
        seed: Seed of the environment and of random actions.
        expert: Whether a scripted expert acts instead.
        **options: Options of `torch_panda.make`.
    """

    def build():
        env = torch_panda.make(env_id, num_threads=1, seed=seed, **options)
        generator = torch.Generator().manual_seed(seed)
        latest = env.reset()
        policy = make_expert(env_id) if expert else None

        def step(k):
            nonlocal latest
            if k and latest["done"].any():
                latest = env.reset()
            if policy is not None:
                action = policy(latest)["action"]
            else:
                action = torch.rand(env.action_spec.shape, generator=generator) * 2 - 1
            latest = env.step(latest.set("action", action))["next"].exclude("reward")

        def state():
            physical = env.get_state()
            return b"".join(
                physical[key].numpy().tobytes() for key in sorted(physical.keys())
            )

        return step, state

    return build


RANDOMIZATION = torch_panda.Randomization(
    object_mass=(0.2, 5.0),
    object_friction=(0.0, 3.0),
    table_friction=(0.0, 3.0),
    finger_friction=(0.2, 2.0),
    object_restitution=(0.0, 0.9),
    joint_damping=(0.0, 2.0),
    gravity=(0.5, 1.5),
    joint_position=0.1,
)
CONTROL_TYPES = ("ee", "ee_pose", "joints", "joint_velocity", "joint_torque")


@pytest.mark.parametrize("env_id", PHYSICS_IDS)
def test_every_task_steps_alike(env_id):
    assert_same(environment(env_id), 15)


@pytest.mark.parametrize("control_type", CONTROL_TYPES)
def test_every_control_type_steps_alike(control_type):
    options = {"control_type": control_type}
    assert_same(environment("PandaPickAndPlace-v3", robot_options=options), 20)


def test_fast_physics_step_alike():
    assert_same(environment("PandaStack-v1", physics="fast"), 40)


@pytest.mark.parametrize("env_id", ["PandaPickAndPlace-v1", "PandaPush-v3"])
def test_objects_in_the_hand_move_alike(env_id):
    counts = assert_same(environment(env_id, expert=True), 50)
    # Bullet creates the first rows of a manifold, for which it enlarges its arrays.
    assert counts.bullet_manifolds < counts.manifolds / 20
    assert (counts.answers, counts.bullet_answers) == (49, 1)


@pytest.mark.parametrize("seed", range(3))
def test_randomized_physics_step_alike(seed):
    build = environment("PandaPush-v1", seed=seed, randomize=RANDOMIZATION)
    assert_same(build, 60)


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["exact", "fast"])
@pytest.mark.parametrize("randomize", [None, RANDOMIZATION])
@pytest.mark.parametrize("seed", range(1, 11))
@pytest.mark.parametrize("env_id", PHYSICS_IDS)
def test_every_task_steps_alike_with_many_seeds(env_id, seed, randomize, physics):
    options = {} if randomize is None else {"randomize": randomize}
    # Bullet solves groups in which one object touches the base and another the hand.
    build = environment(env_id, seed=seed, physics=physics, **options)
    assert_same(build, 120, leaves_groups=None)
