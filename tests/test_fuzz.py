"""Any argument either works or raises one of the documented exceptions.

For longer: ``FUZZ_EXAMPLES=5000 pytest tests/test_fuzz.py``.
"""

import os

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from tensordict import TensorDict

import torch_panda
from torch_panda.gymnasium_envs import GoalVectorEnv

NUM_ENVS = 2
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", 30))
fuzz = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize="FUZZ_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
# A refused argument, action or state; and physics that cannot go on from a state.
DOCUMENTED = (ValueError, TypeError, torch_panda.BulletError)

numbers = st.one_of(
    st.floats(width=64),  # NaN, infinities, denormals and huge values among them
    st.sampled_from([0.0, -0.0, 5e-324, 1e-45, 3.4e38, 1e300, 2.0**63, float("nan")]),
    st.floats(-1, 1),
)
things = st.one_of(st.none(), st.booleans(), st.integers(-3, 3), st.text(), numbers)
dtypes = st.sampled_from(
    [
        torch.float32,
        torch.float64,
        torch.float16,
        torch.bfloat16,
        torch.int64,
        torch.uint8,
        torch.bool,
        torch.complex64,
    ]
)


def tensors(shapes):
    """Tensors of any dtype and value, most of the right shape."""

    def build(shape_and_dtype):
        shape, dtype = shape_and_dtype
        values = st.lists(
            numbers, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))
        )
        return values.map(lambda x: _cast(x, shape, dtype))

    return st.tuples(shapes, dtypes).flatmap(build)


def _cast(values, shape, dtype):
    values = torch.tensor(values, dtype=torch.float64).reshape(shape)
    if dtype.is_floating_point:
        return values.to(dtype)
    return values.nan_to_num(0, 1, -1).clamp(-9, 9).to(dtype)


def plausible(shape):
    """Tensors that may be accepted: of the right shape and finite, also extreme."""
    values = st.one_of(st.floats(-2, 2), st.floats(-1e6, 1e6), st.just(5e-324))
    size = int(np.prod(shape))
    return st.lists(values, min_size=size, max_size=size).map(
        lambda x: _cast(x, shape, torch.float64)
    )


def near(shape):
    """The right shape most of the time, otherwise a similar one."""
    return st.one_of(
        st.just(shape), st.just(shape), st.just(shape[:-1]), st.just((*shape, 1))
    )


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaStack-v3", num_envs=NUM_ENVS, num_threads=1) as env:
        yield env


@pytest.fixture(scope="module")
def vector_env():
    env = GoalVectorEnv("PandaPush-v1", num_envs=NUM_ENVS, num_threads=1)
    yield env
    env.close()


def check_alive(env):
    td = env.reset()
    td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
    assert td["observation"].isfinite().all()


def test_any_arguments_of_make_work_or_raise_a_documented_error():
    @fuzz
    @given(
        st.fixed_dictionaries(
            {},
            optional={
                "num_envs": things.filter(lambda x: not isinstance(x, int) or x < 3),
                "num_threads": things | st.just(10**30),
                "seed": things | st.just(10**30),
                "max_episode_steps": things | st.just(10**30),
                "on_divergence": things | st.just("reset"),
                "device": st.sampled_from(["cpu", None, "gpu", 1.5]),
            },
        )
    )
    def check(arguments):
        try:
            env = torch_panda.make("PandaReach-v1", **arguments)
        except DOCUMENTED as error:
            assert str(error)
            return
        with env:
            check_alive(env)

    check()


def test_finite_float_actions_are_taken_and_others_change_nothing(env):
    shape = tuple(env.action_spec.shape)
    env.reset()

    @fuzz
    @given(plausible(shape) | tensors(near(shape)))
    def check(action):
        before = env.get_state()
        td = TensorDict({"action": action}, batch_size=NUM_ENVS)
        good = (
            action.shape == shape
            and action.is_floating_point()
            and bool(action.isfinite().all())
        )
        if good:
            after = env.step(td)["next"]
            assert after["observation"].isfinite().all()
        else:
            with pytest.raises((ValueError, TypeError), match="the action"):
                env.step(td)
            assert (env.get_state() == before).all()

    check()


def test_any_state_starts_an_episode_or_changes_nothing(env):
    env.reset()
    right = {key: tuple(value.shape) for key, value in env.get_state().items()}
    entries = {
        key: plausible(shape) | plausible(shape) | tensors(near(shape))
        for key, shape in right.items()
    }
    accepted = []

    @fuzz
    @given(st.fixed_dictionaries({}, optional=entries))
    def check(state):
        state = {k: x for k, x in state.items() if x.shape[:1] == (NUM_ENVS,)}
        if "object_pose" in state and state["object_pose"].shape[-1:] == (7,):
            # Rotations would always be refused: keep them right in most examples.
            pose = state["object_pose"].double()
            if bool(pose.isfinite().all()):
                pose[..., 3:] = torch.tensor([0.0, 0.0, 0.0, 1.0])
            state["object_pose"] = pose
        before = env.get_state()
        try:
            td = env.reset(TensorDict(state, batch_size=NUM_ENVS), set_state=True)
        except DOCUMENTED:
            assert (env.get_state() == before).all()
            return
        accepted.append(state)
        assert td["observation"].isfinite().all()
        for _ in range(2):
            try:
                td = env.step(td.set("action", torch.ones(env.action_spec.shape)))
            except torch_panda.BulletError:
                break
            td = td["next"]
            assert td["observation"].isfinite().all()
        check_alive(env)

    check()
    assert any(accepted)


def test_calls_of_gymnasium_work_or_raise_a_documented_error(vector_env):
    env = vector_env
    arrays = st.one_of(
        st_numpy.arrays(
            st.sampled_from([np.float32, np.float64, np.int64, np.bool_]),
            st.sampled_from([(NUM_ENVS, 3), (NUM_ENVS,), (3,), ()]),
        ),
        things,
        st.lists(numbers, max_size=4),
    )
    resets = st.fixed_dictionaries(
        {},
        optional={
            "seed": st.one_of(things, st.lists(things, max_size=3)),
            "options": st.one_of(
                st.none(),
                st.dictionaries(
                    st.sampled_from(["reset_mask", "state", "other"]),
                    st.one_of(
                        arrays,
                        st.dictionaries(
                            st.sampled_from(["object_pose", "step_count", "other"]),
                            arrays,
                        ),
                    ),
                    max_size=2,
                ),
            ),
        },
    )
    accepted = []

    @fuzz
    @given(arrays, resets)
    def check(action, arguments):
        for call in (
            lambda: env.reset(**arguments)[0],
            lambda: env.step(action)[0],
            lambda: {"observation": env.compute_reward(action, action, {})},
        ):
            try:
                result = call()
            except (*DOCUMENTED, gymnasium.error.Error) as error:
                assert str(error)
                continue
            accepted.append(call)
            if not isinstance(result["observation"], np.float32):
                assert result["observation"].dtype == np.float32
        assert np.isfinite(env.reset()[0]["observation"]).all()

    check()
    assert accepted
