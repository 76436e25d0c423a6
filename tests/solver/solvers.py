"""Running the same simulation with either solver."""

import contextlib

import pytest

from torch_panda.bullet.solver import activate
from torch_panda.bullet.solver.compat import load_library
from torch_panda.bullet.solver.native import FOLLOW, LEAVE, SOLVE

needs_packed = pytest.mark.skipif(
    activate().name != "packed", reason=f"the solver is {activate()}"
)


@contextlib.contextmanager
def solver(name):
    """Step with this solver in the calling thread; yield the library's counts."""
    library = load_library()
    library.set_mode(SOLVE if name == "packed" else LEAVE)
    try:
        yield library
    finally:
        library.set_mode(FOLLOW)


def simulate(build, num_steps, name):
    """States of a scene per step.

    Args:
        build: Called without arguments. It builds the scene and returns two functions:
            one that advances it by a step, and one that returns its state as bytes.
        num_steps: Number of steps.
        name: The solver.

    Returns:
        The state after every step, and the library's counts.
    """
    with solver(name) as library:
        step, state = build()
        states = []
        for k in range(num_steps):
            step(k)
            states.append(state())
        counts = library.counts()
    return states, counts


def assert_same(build, num_steps, *, leaves_groups=False):
    """Assert that both solvers give the same bits after every step.

    Args:
        build: As of `simulate`.
        num_steps: Number of steps.
        leaves_groups: Whether the packed solver leaves groups to Bullet; None if both
            may happen.

    Returns:
        The library's counts of the packed solver.
    """
    expected, counts = simulate(build, num_steps, "bullet")
    assert counts.groups == counts.bullet_groups == counts.bodies == 0
    states, counts = simulate(build, num_steps, "packed")
    for step, (ours, theirs) in enumerate(zip(states, expected, strict=True)):
        assert ours == theirs, f"the states differ after step {step}"
    assert counts.groups > 0 or leaves_groups
    assert leaves_groups is None or (counts.bullet_groups > 0) == leaves_groups
    return counts
