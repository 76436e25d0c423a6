"""Hindsight under `torch.compile`: a compiled loss may sample the buffer itself."""

import pytest
import torch
from torchrl.envs import CatTensors, Compose

from tests.transforms.identifiable import Envs, reward_fn, terminated_fn
from tests.transforms.pipelines import buffer
from torch_panda.transforms import GoalSampler, HindsightRelabel

GOALS = ["desired_goal", "achieved_goal"]


# Arguments of `buffer`, by the name of the case.
CASES = {
    "mixture": lambda: {
        "transform": HindsightRelabel(
            reward_fn, strategy={"future": 0.4, "random": 0.3, "desired": 0.3}
        )
    },
    "GoalSampler": lambda: {
        "transform": GoalSampler(
            {"value_goal": {"current": 0.4, "geometric": 0.6}, "actor_goal": "future"},
            reward_fn,
        )
    },
    "among other transforms": lambda: {
        "transform": Compose(
            HindsightRelabel(reward_fn, terminated_fn=terminated_fn, seed=3),
            CatTensors(GOALS, "goals", del_keys=False),
        )
    },
}


@pytest.fixture(autouse=True)
def fresh_compiler():
    """Compile anew in each test, each function for two sizes of its inputs at most.

    The second size is where `torch.compile` begins to trace sizes as variables. More
    sizes would only take longer.
    """
    torch.compiler.reset()
    with torch._dynamo.config.patch(recompile_limit=2):
        yield
    torch.compiler.reset()


def run(step, *, compiled):
    """Batches of some calls. The buffer is overwritten several times on the way."""
    if compiled:
        step = torch.compile(step, backend="eager")
    torch.manual_seed(1)
    envs = Envs(3, [5, 8])
    return [step(envs.chunk(20 + k).reshape(-1)) for k in range(3)]


def assert_equal(batches, expected):
    for batch, other in zip(batches, expected, strict=True):
        assert set(batch.keys(True, True)) == set(other.keys(True, True))
        assert (batch == other).all()


@pytest.mark.parametrize("case", CASES)
def test_a_compiled_loss_samples_the_batches_of_the_eager_one(case):
    def play(*, compiled):
        rb = buffer(capacity=100, **CASES[case]())
        rb.extend(Envs(3, [5, 8], first_env=10).chunk(20).reshape(-1))

        def sample(data):
            batch = rb.sample()
            batch["loss"] = batch["next", "reward"] * batch["desired_goal"]
            return batch

        def step(data):
            rb.extend(data)
            return compiled_sample(data)

        compiled_sample = torch.compile(sample, backend="eager") if compiled else sample
        return run(step, compiled=False)

    assert_equal(play(compiled=True), play(compiled=False))


@pytest.mark.slow
def test_a_compiled_step_writes_and_samples_as_the_eager_one():
    def play(*, compiled):
        rb = buffer(capacity=100, **CASES["mixture"]())

        def step(data):
            rb.extend(data)
            return rb.sample()

        return run(step, compiled=compiled)

    assert_equal(play(compiled=True), play(compiled=False))
