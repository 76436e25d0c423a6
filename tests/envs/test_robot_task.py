"""The contract of `RobotTaskEnv` that does not depend on the id."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

import torch_panda
from tests.devices import on_gpu
from tests.pushing import pusher
from torch_panda.bullet import PhysicsClient
from torch_panda.bullet.solver import activate
from torch_panda.envs import robot_task


def run(env, steps):
    """Reset the environments, push the objects for some steps, and observe them."""
    policy, td = pusher(env, noise=0.3), env.reset()
    for _ in range(steps):
        td = env.step(policy(td))["next"]
    return td


@pytest.fixture
def env():
    with torch_panda.make("PandaPush-v1", num_envs=3, num_threads=2, seed=0) as env:
        yield env


# ---- reproducibility ---------------------------------------------------------


@pytest.mark.parametrize("index", [-1, 3])
def test_only_environments_that_exist_are_seeded(env, index):
    with pytest.raises(ValueError, match=f"env must be from 0 to 2, got {index}"):
        env.set_env_seed(index, 0)


def test_default_dtype_and_device_change_nothing():
    def observe():
        with torch_panda.make(
            "PandaPush-v1", seed=0, depth=True, sensors=("joint_torque",)
        ) as env:
            td = env.rollout(2, lambda td: td.set("action", torch.ones(3).cpu()))
            exact = env.get_state(exact=True)
            env.reset(exact, set_state=True)
            assert env.rand_action()["action"].dtype == env.action_spec.dtype
            return td["next"], env.get_state(), exact

    expected = observe()
    torch.set_default_dtype(torch.float64)
    try:
        actual = observe()
    finally:
        torch.set_default_dtype(torch.float32)
    for before, after in zip(expected, actual, strict=True):
        for key in set(before.keys()):
            assert before[key].dtype == after[key].dtype, key
            assert torch.equal(before[key], after[key]), key
    with torch.device("meta"), torch_panda.make("PandaPush-v1", seed=0) as env:
        start = env._reset()
    assert start["observation"].device.type == "cpu"


# ---- resets and states -------------------------------------------------------


def test_the_first_call_must_be_a_reset(env):
    action = TensorDict({"action": torch.zeros(3, 3)}, batch_size=[3])
    with pytest.raises(torch_panda.BulletError, match="never reset"):
        env.step(action)
    with pytest.raises(torch_panda.BulletError, match="never reset"):
        env.get_state()
    only_first = torch.tensor([[True], [False], [False]])
    env.reset(TensorDict({"_reset": only_first}, batch_size=[3]))
    with torch_panda.make("PandaPush-v1", num_envs=3, seed=0) as other:
        other.reset()
        assert (env.get_state() == other.get_state()).all()
    env.set_seed(1)
    env.step(action)  # a new seed takes effect in the next episode


def test_unknown_options_of_a_reset_are_refused(env):
    for refusing in (env, TransformedEnv(env)):
        with pytest.raises(TypeError, match="unexpected keyword argument 'seed'"):
            refusing.reset(seed=0)
    env.reset()
    with pytest.raises(TypeError, match="unexpected keyword argument 'set_sate'"):
        env.reset(env.get_state(), set_sate=True)


def test_a_partial_reset_changes_no_bit_of_the_other_environments(env):
    with torch_panda.make("PandaPush-v1", num_envs=3, seed=0) as other:
        policy, td, untouched = pusher(env, noise=0.3), env.reset(), other.reset()
        for step in range(30):
            untouched["action"] = policy(td)["action"]
            td, untouched = env.step(td)["next"], other.step(untouched)["next"]
            if step == 10:
                td["_reset"] = torch.tensor([[False], [True], [False]])
                td = env.reset(td)
        for env_index in (0, 2):
            assert (td[env_index] == untouched[env_index]).all()
        assert env.get_state()["step_count"].flatten().tolist() == [30, 19, 30]


def test_a_partial_reset_returns_the_entries_of_all_environments(env):
    env.reset()
    state = env.get_state()
    td = env.reset()
    td = env.step(td.set("action", torch.ones(3, 3)))["next"]
    mask = torch.tensor([[True], [False], [False]])
    from_state = env.reset(state.clone().set("_reset", mask), set_state=True)
    anew = env.reset(TensorDict({"_reset": mask}, [3]))
    for start in (from_state, anew):
        assert "_reset" not in set(start.keys())
        for key in ("observation", "achieved_goal", "desired_goal"):
            assert torch.equal(start[key][1:], td[key][1:])
            assert start[key].dtype == env.observation_spec[key].dtype
    goal = env.get_state()["desired_goal"].float()
    assert torch.equal(anew["desired_goal"], goal)
    assert torch.equal(from_state["desired_goal"][0], state["desired_goal"][0].float())


def test_a_partial_step_leaves_the_other_environments_alone(env):
    td = env.reset()
    before = env.get_state()
    td["action"] = torch.ones(3, 3)
    td["_step"] = torch.tensor([True, False, True])
    after = env.step(td)["next"]
    assert torch.equal(after["observation"][1], td["observation"][1])
    assert after["reward"][1] == 0
    assert not torch.equal(after["observation"][0], td["observation"][0])
    assert env.get_state()["step_count"].flatten().tolist() == [1, 0, 1]
    assert (env.get_state()[1] == before[1]).all()


@pytest.mark.parametrize("num_envs", [None, 3])
def test_a_step_equals_torchrls_own_step(num_envs):
    """`step` skips torchrl's checks of the result, but returns the same result."""
    steps = []
    for step in (torch_panda.RobotTaskEnv.step, EnvBase.step):
        with torch_panda.make("PandaPush-v1", num_envs=num_envs, seed=0) as env:
            td = env.reset().set("action", torch.ones(env.action_spec.shape))
            stepped = step(env, td)
            assert stepped is td
            preset = td["next"].select("reward").rename_key_("reward", "mine")
            again = step(env, td.exclude("next").set("next", preset))
            steps.append((stepped, again))
    for ours, theirs in zip(*steps, strict=True):
        assert ours.batch_size == theirs.batch_size
        actual, expected = ours["next"], theirs["next"]
        assert set(actual.keys()) == set(expected.keys())
        for key, value in expected.items():
            assert actual[key].dtype == value.dtype
            assert torch.equal(actual[key], value)


def test_a_rollout_equals_torchrls_own_rollout(env):
    def roll(method, **options):
        env.set_seed(3)
        torch.manual_seed(0)
        return method(env, 7, **options)

    rollout = torch_panda.RobotTaskEnv.rollout
    ours, theirs = roll(rollout), roll(EnvBase.rollout)
    assert (ours == theirs).all()
    assert ours.names == theirs.names
    assert (ours["action"][:, 1:] != ours["action"][:, :-1]).all()
    actions = [*ours["action"].unbind(1)]
    for played in (
        roll(rollout, actions=actions),
        roll(rollout, policy=lambda td: td.set("action", actions.pop(0))),
    ):
        assert (played == ours).all()


def test_a_state_that_is_set_and_read_keeps_float64(env):
    run(env, 20)
    state = env.get_state()
    assert state["object_pose"].dtype == torch.float64
    env.reset()
    env.reset(state.clone(), set_state=True)
    again = env.get_state()
    for key, value in state.items():
        # Bullet reports rotations from a matrix: the last bit may differ.
        tolerance = 1e-15 if key == "object_pose" else 0.0
        torch.testing.assert_close(again[key], value, rtol=0.0, atol=tolerance)


def test_a_step_observes_the_hand_one_substep_before_its_state(env):
    td = run(env, 20)
    hand, velocity = td["observation"][:, :6].split(3, dim=1)
    start = env.reset(env.get_state(), set_state=True)
    moved = start["observation"][:, :3] - hand
    assert (moved.abs().amax(1) > 1e-5).all()
    torch.testing.assert_close(moved, velocity / 500, rtol=0.0, atol=1e-5)


def test_a_partial_state_leaves_the_rest_neutral_or_sampled(env):
    pose = torch.tensor([0.1, 0.0, 0.02, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    partial_state = TensorDict({"object_pose": pose.expand(3, 1, 7)}, batch_size=[3])
    td = env.reset(partial_state, set_state=True)
    state = env.get_state()
    assert torch.equal(state["object_pose"], partial_state["object_pose"])
    neutral = torch.tensor(env.robot.neutral_joint_position, dtype=torch.float64)
    assert torch.equal(state["joint_position"], neutral.expand(3, 9))
    assert not state["object_velocity"].any()
    assert len(td["desired_goal"].unique(dim=0)) == 3


def test_a_state_can_be_used_again(env):
    run(env, 20)
    state = env.get_state()
    before = state.clone()
    run(env, 2)
    assert (state == before).all()  # not a view of the running simulation
    first = env.reset(state, set_state=True)
    assert set(state.keys()) == set(before.keys())
    assert (state == before).all()
    run(env, 5)
    again = env.reset(state, set_state=True)
    assert (first == again).all()


@pytest.mark.parametrize("state", [{}, {"step_count": torch.zeros(3, 1)}, None])
def test_starting_from_a_missing_state_is_refused(env, state):
    state = None if state is None else TensorDict(state, [3])
    message = "some of joint_position, .*, object_velocity, desired_goal, got none"
    with pytest.raises(ValueError, match=message):
        env.reset(state, set_state=True)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("object_pose", lambda x: x[:, :, :6], r"object_pose must have shape"),
        ("object_pose", lambda x: x * 0, r"environment 0 .*unit quaternion"),
        ("joint_position", lambda x: x / 0, r"joint_position of environment 0"),
        ("step_count", lambda x: x - 1, r"step_count of environment 0"),
    ],
)
def test_a_bad_state_is_refused_and_changes_nothing(env, key, change, message):
    env.reset()
    state = env.get_state()
    bad = state.clone().exclude(key)
    bad[key] = change(state[key])
    with pytest.raises(ValueError, match=message):
        env.reset(bad, set_state=True)
    assert (env.get_state() == state).all()


@pytest.mark.parametrize(
    ("env_id", "end"),
    [
        ("PandaReach-v1", "truncated"),
        ("PandaReach-v3", "terminated"),
        ("PandaReachDense-v3", "terminated"),
    ],
)
def test_an_episode_can_start_from_the_last_state_of_another(env_id, end):
    with torch_panda.make(env_id, num_envs=2, seed=0) as env:
        td = env.reset()
        td["action"] = torch.zeros(2, 3)
        env.step(td)
        state = env.get_state()
        state["step_count"][:] = 50
        state["desired_goal"] = env.step(td)["next", "achieved_goal"].double()
        td = env.reset(state, set_state=True)
        assert not td["done"].any()
        td = env.step(td.set("action", torch.zeros(2, 3)))["next"]
        assert td[end].all() and td["done"].all()
        assert td["success"].all()


# ---- bad input ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("action", "error", "message"),
    [
        (torch.tensor([[0.0] * 3, [0.0, float("nan"), 0.0], [0.0] * 3]), 0, "ment 1"),
        (torch.tensor([[0.0] * 3, [0.0] * 3, [float("inf")] * 3]), 0, "ment 2"),
        (torch.tensor([[-float("inf")] * 3, [0.0] * 3, [0.0] * 3]), 0, "ment 0"),
        (torch.zeros(3, 4), 0, r"shape \(3, 3\), got \(3, 4\)"),
        (
            torch.zeros(3, 3, dtype=torch.int64),
            1,
            "dtype, got torch.int64: pass",
        ),
        (torch.zeros(3, 3, device="meta"), 0, "device cpu, got meta"),
    ],
)
def test_a_bad_action_is_refused_and_changes_nothing(env, action, error, message):
    td = env.reset()
    state = env.get_state(exact=True)
    with pytest.raises((ValueError, TypeError)[error], match=message):
        env.step(TensorDict({"action": action}, batch_size=[3]))
    assert (env.get_state(exact=True) == state).all()
    env.step(td.set("action", torch.zeros(3, 3)))


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"num_envs": 0}, ValueError),
        ({"num_envs": True}, TypeError),
        ({"num_threads": 2.5}, TypeError),
        ({"seed": -1}, ValueError),
        ({"on_divergence": "ignore"}, ValueError),
        ({"renderer": "gl"}, ValueError),
        ({"physics": "fastest"}, ValueError),
        ({"physics": 3}, ValueError),
        ({"render_size": 64}, ValueError),  # without pixels, nothing is rendered
        ({"camera": torch_panda.Camera()}, ValueError),
    ],
)
def test_bad_arguments_of_make_are_refused_by_name(arguments, error):
    (name,) = arguments
    with pytest.raises(error, match=name):
        torch_panda.make("PandaReach-v1", **arguments)


@pytest.mark.parametrize("camera", ["front", {"distance": 1.0}])
def test_a_camera_of_a_wrong_type_is_refused(env, camera):
    for call in (
        lambda: torch_panda.make("PandaReach-v1", from_pixels=True, camera=camera),
        lambda: env.render(camera=camera),
        lambda: env.open_window(camera),
    ):
        with pytest.raises(TypeError, match="camera must be an instance of Camera"):
            call()


@pytest.mark.parametrize("size", [0, "a", (), (64, 64, 3)])
def test_a_bad_render_size_is_refused(size):
    with pytest.raises((ValueError, TypeError), match=r"size|width"):
        torch_panda.make("PandaReach-v1", from_pixels=True, render_size=size)


def test_a_viewer_without_its_extra_is_refused(env, monkeypatch):
    monkeypatch.setattr(robot_task, "find_spec", lambda name: None)
    message = r"^viewers need viser and yourdfpy: pip install -e '.*\[viewer\]'$"
    with pytest.raises(ImportError, match=message):
        env.open_viewer()


def test_use_after_close_is_refused():
    env = torch_panda.make("PandaReach-v1", num_envs=2)
    td = env.reset()
    env.close()
    env.close()
    td["action"] = torch.zeros(2, 3)
    for use in (env.reset, env.get_state, lambda: env.step(td)):
        with pytest.raises(torch_panda.BulletError, match=r"closed: make.*Collector"):
            use()


def test_clients_are_closed_if_an_environment_cannot_be_built(monkeypatch):
    clients = []
    connect = PhysicsClient.__init__
    monkeypatch.setattr(
        PhysicsClient,
        "__init__",
        lambda self, **options: clients.append(self) or connect(self, **options),
    )
    task = torch_panda.Reach()
    task.observation_dim = 2
    with pytest.raises(ValueError, match=r"observation must return shape \(2, 2\)"):
        torch_panda.RobotTaskEnv(robot=torch_panda.Panda(), task=task, num_envs=2)
    assert len(clients) == 2
    for client in clients:
        with pytest.raises(torch_panda.BulletError, match="closed"):
            client.step(1)


def test_a_cpu_may_have_an_index():
    with torch_panda.make("PandaReach-v1", num_envs=2, device="cpu:0") as env:
        check_env_specs(env)
        assert env.rollout(2)["next", "observation"].shape == (2, 2, 6)


@on_gpu
def test_outputs_and_states_are_on_the_given_cuda_device():
    with torch_panda.make("PandaPush-v1", num_envs=2, device="cuda") as env:
        td = env.rollout(3)
        assert td.device.type == td["next", "observation"].device.type == "cuda"
        assert env.get_state()["object_pose"].device.type == "cuda"


def test_the_repr_of_an_environment_shows_its_parts_and_solver():
    with torch_panda.make("PandaReach-v1", num_envs=2, seed=3) as env:
        text = repr(env)
    assert text.startswith("RobotTaskEnv(robot=Panda(control_type='ee', ")
    assert "fingers_width=0.0" in text
    assert "task=Reach(reward_type='sparse'" in text
    call, solver = text.split(" [solver: ")
    assert call.endswith("num_envs=2, seed=3, max_episode_steps=50)")
    assert solver == f"{activate().name}]"
    assert "device" not in text
