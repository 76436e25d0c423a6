"""Goal environments of Gymnasium, as one batched environment to learn in."""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import gymnasium
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from tensordict import TensorDict
from torchrl.envs.utils import RandomPolicy, check_env_specs, step_mdp

from tests.commands.runs import read_curve, weights
from tests.learning.hand_env import HIGH, LOW, MAX_STEPS, NEAR, SPEED, HandEnv, register
from torch_panda.commands import evaluate, main, train, watch
from torch_panda.commands.train import parse
from torch_panda.datasets import generate, sha256
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.environments import is_from_gymnasium, make_env
from torch_panda.learning.environments.geometry import find_geometry, find_hand, probe
from torch_panda.learning.environments.gym_goal_env import GymGoalEnv
from torch_panda.learning.evaluation.video import record
from torch_panda.learning.options import default_args
from torch_panda.learning.training import Run

GOALS = ("achieved_goal", "desired_goal")
# Columns of the observation of `HandEnv`.
TIME, OBJECT, HAND, ACTION = 0, 4, 7, slice(10, 14)


@pytest.fixture
def make():
    """Make environments, which are closed afterwards."""
    envs = []

    def make_hands(num_envs=2, seed=0, workers=1, **options):
        env_id = register(**options)
        envs.append(GymGoalEnv(env_id, num_envs=num_envs, seed=seed, workers=workers))
        return envs[-1]

    yield make_hands
    for env in envs:
        env.close()


def play(env, steps, seed=0):
    """Play with actions that are the same for the same seed."""
    torch.manual_seed(seed)
    return env.rollout(steps, break_when_any_done=False)


def near(data):
    difference = data["achieved_goal"] - data["desired_goal"]
    return difference.norm(dim=-1, keepdim=True) <= NEAR


# ---- episodes ----------------------------------------------------------------------


@pytest.mark.parametrize("workers", [1, 2])
def test_the_last_observation_of_an_episode_is_the_true_one(make, workers):
    data = play(make(workers=workers), MAX_STEPS + 2)
    time = data["observation"][0, :, TIME].tolist()
    next_time = data["next", "observation"][0, :, TIME].tolist()
    assert time == [*range(MAX_STEPS), 0, 1]
    assert next_time == [*range(1, MAX_STEPS + 1), 1, 2]
    goals = data["next", "desired_goal"]
    assert torch.equal(goals[:, MAX_STEPS - 1], goals[:, 0])
    assert (goals[:, MAX_STEPS] != goals[:, 0]).any(-1).all()
    ends = data["next", "done"].squeeze(-1)
    assert ends.nonzero()[:, 1].tolist() == [MAX_STEPS - 1] * 2
    assert torch.equal(data["next", "truncated"].squeeze(-1), ends)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_partial_reset_leaves_the_other_environments_alone(make, workers):
    env = make(workers=workers)
    before = env.rollout(3)[:, -1]["next"]
    mask = torch.tensor([[True], [False]])
    after = env.reset(before.clone().set("_reset", mask))
    assert after["observation"][:, TIME].tolist() == [0, 3]
    assert torch.equal(after["desired_goal"][1], before["desired_goal"][1])
    assert not torch.equal(after["desired_goal"][0], before["desired_goal"][0])
    following = env.rand_step(after)["next", "observation"]
    assert following[:, TIME].tolist() == [1, 4]
    assert torch.equal(after["observation"][:, TIME], torch.tensor([0.0, 3.0]))


def test_an_environment_that_is_stepped_after_its_end_begins_an_episode(make):
    env = make()
    state = env.rollout(3)[:, -1]["next"]
    state = env.reset(state.set("_reset", torch.tensor([[True], [False]])))
    times, ends = [], []
    for _ in range(MAX_STEPS):
        state = step_mdp(env.rand_step(state))
        times.append(state["observation"][:, TIME].tolist())
        ends.append(state["done"].flatten().tolist())
    late = [*range(4, MAX_STEPS + 1), 1, 2, 3]
    assert times == [list(x) for x in zip(range(1, MAX_STEPS + 1), late, strict=True)]
    assert [k for k, end in enumerate(ends) if end[1]] == [MAX_STEPS - 4]
    assert [k for k, end in enumerate(ends) if end[0]] == [MAX_STEPS - 1]


def test_equal_seeds_give_equal_episodes_with_any_number_of_processes(make):
    """Also the second episode of each environment, which continues its generator."""
    steps = MAX_STEPS + 5
    expected = play(make(seed=3), steps)
    assert (expected["desired_goal"][0, 0] != expected["desired_goal"][1, 0]).all()
    for workers in (1, 2):
        env = make(seed=3, workers=workers)
        assert (play(env, steps) == expected).all()
        env.set_seed(4)
        assert not (play(env, steps) == expected)["desired_goal"].any()
        env.set_seed(3)
        assert (play(env, steps) == expected).all()


def test_each_environment_has_a_process_of_its_own_with_workers(make):
    env = make(num_envs=3, workers=2)
    assert isinstance(env._vector, gymnasium.vector.AsyncVectorEnv)
    processes = env._vector.processes
    assert len({process.pid for process in processes}) == 3
    env.close()
    env.close()
    assert not any(process.is_alive() for process in processes)


def test_torchrl_accepts_the_specs(make):
    check_env_specs(make())


# ---- numbers -----------------------------------------------------------------------


def test_actions_are_scaled_to_the_bounds_and_clipped(make):
    env = make(num_envs=4)
    state = env.reset()
    values = torch.tensor([-1.0, 0.0, 1.0, 7.0])
    state["action"] = values[:, None].expand(4, 4).clone()
    taken = env.step(state)["next", "observation"][:, ACTION]
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    expected = torch.stack((low, (low + high) / 2, high, high))
    torch.testing.assert_close(taken, expected)
    assert torch.equal(taken[[0, 2, 3]], expected[[0, 2, 3]])


def test_all_numbers_are_float32_and_new_tensors(make):
    env = make()
    data = play(env, 3)
    for key in ("observation", *GOALS, "reward"):
        assert data["next", key].dtype == torch.float32
    state = env.reset()
    following = env.rand_step(state)["next"]
    kept = following.clone()
    env.rand_step(state)
    assert (following == kept).all()


def test_pictures_have_the_requested_size():
    with make_env(register(), num_envs=2, renders=True) as env:
        env.reset()
        pictures = env.render(size=(20, 30))
    assert pictures.shape == (2, 20, 30, 3)
    assert pictures.dtype == torch.uint8
    assert (pictures[:, :, :10] == 0).all()
    assert (pictures[:, :, 20:] == 255).all()


def test_a_video_is_as_fast_as_the_simulation(tmp_path):
    class Fast(HandEnv):
        metadata: ClassVar = {**HandEnv.metadata, "render_fps": 50}

    path = tmp_path / "fast.mp4"
    with make_env(register(Fast), num_envs=2, renders=True) as env:
        record(env, RandomPolicy(env.action_spec), path)
    assert iio.immeta(path)["fps"] == 50


def test_a_simulator_that_cannot_render_is_an_os_error():
    message = r"cannot be rendered \(no display\); .* needs MUJOCO_GL=egl"
    with make_env(register(is_broken=True), renders=True) as env:
        env.reset()
        with pytest.raises(OSError, match=message):
            env.render(size=(20, 30))


# ---- rewards and success -----------------------------------------------------------


@pytest.mark.parametrize(
    ("goals", "rewards"),
    [
        *(("several", rewards) for rewards in ("sparse", "binary", "dense")),
        *(("raises", "sparse"), ("norm", "binary"), ("indices", "dense")),
    ],
)
def test_rewards_are_computed_for_goals_of_any_batch_shape(make, goals, rewards):
    env = make(num_envs=1, goals=goals, rewards=rewards)
    assert env.has_sparse_reward == (rewards == "sparse")
    for shape in ((), (1,), (3,), (2, 4), (2, 0)):
        achieved, desired = torch.randn(2, *shape, 3) / 2
        distance = (achieved - desired).norm(dim=-1, keepdim=True)
        expected = {
            "sparse": -(distance > NEAR).float(),
            "binary": (distance <= NEAR).float(),
            "dense": -distance,
        }[rewards]
        reward = env.compute_reward(achieved, desired)
        assert reward.dtype == torch.float32
        torch.testing.assert_close(reward, expected)
        is_near = (distance <= NEAR) & (rewards != "dense")
        assert torch.equal(env.is_success(achieved, desired), is_near)
        is_shown = torch.full_like(is_near, rewards != "dense")
        assert torch.equal(env.is_success(desired, desired), is_shown)
    data = play(env, 5)["next"]
    told = env.compute_reward(data["achieved_goal"], data["desired_goal"])
    torch.testing.assert_close(told, data["reward"])


def test_a_batch_of_goals_is_one_call(make, monkeypatch):
    env, sizes = make(), []
    compute = HandEnv.compute_reward

    def compute_and_note(hand, *arguments):
        sizes.append(len(arguments[0]))
        return compute(hand, *arguments)

    monkeypatch.setattr(HandEnv, "compute_reward", compute_and_note)
    env.compute_reward(*torch.randn(2, 5, 100, 3))
    assert sizes == [500]


def test_coordinates_are_not_taken_for_goals_of_a_batch(make):
    """A batch of two goals has as many rows as a goal has coordinates."""
    env = make(goals="indices", goal_size=2)
    achieved, desired = torch.randn(2, 5, 2)
    is_far = (achieved - desired).norm(dim=-1, keepdim=True) > NEAR
    assert torch.equal(env.compute_reward(achieved, desired), -is_far.float())


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    ("tells", "parity"),
    [
        ([("is_success", "odd")], 1),
        ([("success", "even")], 0),
        ([("success", "even"), ("is_success", "odd")], 1),
    ],
)
def test_the_info_says_whether_a_goal_is_reached(make, workers, tells, parity):
    data = play(make(tells=tells, workers=workers), 6)["next"]
    is_told = data["observation"][..., [TIME]] % 2 == parity
    assert torch.equal(data["success"], is_told)


@pytest.mark.parametrize("rewards", ["sparse", "binary", "dense"])
def test_without_information_the_rewards_say_whether_a_goal_is_reached(make, rewards):
    data = play(make(num_envs=8, rewards=rewards), 2 * MAX_STEPS)
    expected = near(data)
    assert 0.1 < expected.float().mean() < 0.9
    if rewards == "dense":
        expected = torch.zeros_like(expected)
    assert torch.equal(data["success"], expected)  # also that of a reset
    if rewards != "dense":
        assert torch.equal(data["next", "success"], near(data["next"]))


def test_the_info_of_some_environments_is_theirs_alone(make):
    tells = [("is_success", "only where x > 0")]
    data = play(make(num_envs=8, tells=tells), MAX_STEPS)["next"]
    is_positive = data["observation"][..., [HAND]] > 0
    assert torch.equal(data["success"], is_positive | near(data))
    assert (is_positive & ~near(data)).any()
    assert (~is_positive & near(data)).any()


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("ends", ["success", "failure"])
def test_success_truncates_an_episode_and_failure_terminates_it(make, ends, workers):
    data = play(make(ends=ends, rewards="dense", workers=workers), 7)["next"]
    ended, other = ("truncated", "terminated")[:: 1 if ends == "success" else -1]
    is_end = torch.arange(7) == 4
    assert torch.equal(data[ended].squeeze(-1), is_end.expand(2, 7))
    assert torch.equal(data["done"], data[ended])
    assert not data[other].any()
    assert data["observation"][0, :, TIME].tolist() == [1, 2, 3, 4, 5, 1, 2]


# ---- environments that cannot be used ------------------------------------------------


def _box(*shape):
    return Box(-1.0, 1.0, shape)


def _observed(**changes):
    spaces = {"observation": _box(4), "achieved_goal": _box(3), "desired_goal": _box(3)}
    return Dict({key: x for key, x in (spaces | changes).items() if x is not None})


NO_DICT = "its observations must be a Dict of flat boxes named observation, ach"


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"observation_space": _box(4)}, NO_DICT),
        ({"observation_space": _observed(desired_goal=None)}, NO_DICT),
        ({"observation_space": _observed(observation=_box(2, 2))}, NO_DICT),
        ({"observation_space": _observed(achieved_goal=Discrete(3))}, NO_DICT),
        (
            {"observation_space": _observed(desired_goal=_box(2))},
            "achieved_goal and desired_goal differ in size",
        ),
        ({"action_space": Discrete(4)}, "its actions must be a flat, bounded box, got"),
        ({"action_space": _box(2, 2)}, "its actions must be a flat, bounded box, got"),
        (
            {"action_space": Box(-np.inf, 1.0, (2,))},
            "its actions must be a flat, bounded box, got",
        ),
        ({"compute_reward": None}, "it has no method compute_reward"),
        ({"max_episode_steps": None}, "its registration has no max_episode_steps"),
        (
            {"action_space": Discrete(4), "max_episode_steps": None},
            r"flat, bounded box, got Discrete\(4\); its registration has no",
        ),
    ],
)
def test_an_environment_that_cannot_be_used_is_refused(attributes, message):
    steps = attributes.get("max_episode_steps", MAX_STEPS)

    class Other(HandEnv):
        def __init__(self):
            super().__init__()
            for name, value in attributes.items():
                setattr(self, name, value)

    env_id = register(Other, max_episode_steps=steps)
    with pytest.raises(ValueError, match=f"{env_id} cannot be used: .*{message}"):
        GymGoalEnv(env_id)


def test_an_environment_need_not_take_a_render_mode():
    class Plain(HandEnv):
        def __init__(self):
            super().__init__()

    with GymGoalEnv(register(Plain)) as env:
        assert env.rollout(2).batch_size == (1, 2)


def test_our_own_environments_need_no_processes():
    with pytest.raises(ValueError, match=r"got workers=2: drop --workers"):
        make_env("PandaReach-v1", workers=2)


def test_an_unknown_id_is_refused():
    with pytest.raises(ValueError, match=r"^Gymnasium cannot make 'Nothing-v0': "):
        GymGoalEnv("Nothing-v0")
    message = "'Nothing-v0'.*; an id of Gymnasium needs the module that registers it"
    with pytest.raises(ValueError, match=message):
        make_env("Nothing-v0")


@pytest.mark.parametrize("option", ["num_envs", "workers"])
def test_numbers_of_environments_and_workers_must_be_positive(option):
    with pytest.raises(ValueError, match=f"{option} must be .* from 1 .*, got 0"):
        GymGoalEnv(register(), **{option: 0})


def test_ids_of_both_libraries_are_told_apart():
    assert is_from_gymnasium(register())
    assert not is_from_gymnasium("PandaPush-v1")
    with make_env(register(), num_envs=3, physics="exact", task_options={}) as env:
        assert env.batch_size == (3,)
    message = "is an environment of Gymnasium, which has no physics or sensors"
    with pytest.raises(ValueError, match=message):
        make_env(register(), physics="fast", sensors=["camera"])


# ---- layout --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "hand", "object_column"),
    [
        (("hand", "object", "velocity", "action"), 0, 3),
        (("time", "velocity", "object", "hand", "action"), 7, 4),
        (("action", "velocity", "hand", "time"), 7, None),
    ],
)
def test_the_hand_is_found_wherever_it_is_observed(make, parts, hand, object_column):
    rollouts = probe(make(num_envs=4, parts=parts))
    assert rollouts.shape == (16, 30)
    found = find_hand(rollouts)
    assert found.column == hand
    assert found.action_scale == pytest.approx(SPEED, rel=0.2)
    geometry = find_geometry(rollouts, found.column)
    if object_column is None:
        assert geometry.positions == (hand,)
        assert geometry.points == ()
        return
    size = rollouts["observation"].shape[-1]
    assert geometry.positions == (hand, object_column)
    pairs = [(hand, object_column), (object_column, size)]
    assert geometry.points == tuple(p + k for _, p in pairs for k in range(3))
    assert geometry.origins == tuple(o + k for o, _ in pairs for k in range(3))
    assert geometry.goal_positions == (0,)


def test_a_goal_of_the_hand_is_the_hands_position(make):
    rollouts = probe(make(num_envs=4, has_object=False))
    geometry = find_geometry(rollouts, find_hand(rollouts).column)
    assert geometry.positions == (HAND,)
    assert geometry.origins == (HAND, HAND + 1, HAND + 2)
    assert geometry.points == (14, 15, 16)


def test_no_hand_is_found_if_nothing_follows_the_actions(make):
    env = make(num_envs=4, follows=False)
    rollouts = probe(env)
    assert find_hand(rollouts) is None
    geometry = find_geometry(rollouts, None)
    assert geometry.positions == ()
    assert geometry.points == (14, 15, 16)
    assert geometry.origins == (OBJECT, OBJECT + 1, OBJECT + 2)
    with pytest.raises(ValueError, match="three actions that displace a hand"):
        make_agent(env, Hyperparameters(exploration="points"))


def test_two_actions_move_no_hand():
    action = torch.randn(4, 30, 2)
    observation = action.cumsum(1)[..., [0, 1, 1]]
    following = {"done": torch.zeros(4, 30, 1, dtype=torch.bool)}
    data = {"action": action, "observation": observation, "next": following}
    rollouts = TensorDict(data, (4, 30))
    assert find_hand(rollouts) is None


# ---- commands ------------------------------------------------------------------------


@pytest.mark.usefixtures("quick")
def test_a_training_is_resumed_evaluated_and_watched(tmp_path, capsys):
    env_id = register()
    options = ["--env-id", env_id, "--num-envs", "4", "--eval-interval", "80"]
    options += ["--updates-per-step", "0.1"]
    stopped, whole = tmp_path / "stopped", tmp_path / "whole"
    for out, steps, *others in (
        (whole, "160"),
        (stopped, "80", "--no-video"),
        (stopped, "160", "--resume"),
    ):
        steps = ["--total-steps", steps, "--out", str(out)]
        train.main(parse([*options, *steps, *others]))
    assert [row["step"] for row in read_curve(stopped)] == ["0", "80", "160"]
    runs = []
    for out in (whole, stopped):
        arguments = [*options, "--total-steps", "160", "--out", str(out), "--resume"]
        runs.append(Run(parse(arguments), out))
        runs[-1].close()
    torch.testing.assert_close(*map(weights, runs), rtol=0, atol=0)
    assert runs[0].agent.spaces.geometry.positions == (HAND, OBJECT)
    assert runs[0].agent.spaces.has_free_gripper
    assert (whole / "video.mp4").exists()

    results = []
    for workers in (1, 2):
        capsys.readouterr()
        evaluate.main(evaluate.Args(run=stopped, episodes=3, workers=workers))
        results.append(capsys.readouterr().out)
    assert results[0] == results[1]
    assert results[0].startswith(f"{env_id}, 3 episodes\n")
    watched = tmp_path / "watch.gif"
    main(["watch", "--policy", str(stopped), "--num-envs", "1", "--out", str(watched)])
    assert watched.stat().st_size


def test_the_recipe_derives_its_options_from_random_actions():
    args = parse(["--env-id", register()])
    assert args.gamma == parse(["--env-id", register(follows=False)]).gamma
    assert (args.exploration, args.her) == ("points", "relabel")
    for options in ({"follows": False}, {"num_actions": 5}):
        assert parse(["--env-id", register(**options)]).exploration == "actions"


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"start_at_reached": 0.5}, "start_at_reached"),
        ({"demos": Path("demos.pt")}, "demos"),
        ({"physics": "fast"}, "physics"),
        ({"task_options": {"goal_range": 1.0}}, "task_options"),
        ({"randomize": 2.0}, "randomize"),
        ({"physics": "fast", "randomize": 2.0}, "physics or randomize"),
    ],
)
def test_options_of_our_own_environments_are_refused(tmp_path, options, name):
    env_id = register()
    args = replace(default_args("recipe", env_id), out=tmp_path / "run", **options)
    message = f"^{env_id} is an environment of Gymnasium, which has no {name}$"
    with pytest.raises(SystemExit, match=message):
        train.main(args)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("quick")
def test_other_commands_refuse_features_of_our_own_environments(tmp_path):
    env_id, run = register(), tmp_path / "run"
    args = default_args("recipe", env_id)
    train.main(replace(args, num_envs=1, total_steps=1, video=False, out=run))
    for command, args, name in (
        (evaluate, evaluate.Args(run, tasks="fixed"), "fixed tasks"),
        (evaluate, evaluate.Args(run, physics="fast"), "physics"),
        (watch, watch.Args(policy=str(run), human=True), "window or viewer"),
        (watch, watch.Args(policy=str(run), web=True), "window or viewer"),
    ):
        message = f"^{env_id} is an environment of Gymnasium, which has no {name}$"
        with pytest.raises(SystemExit, match=message):
            command.main(args)


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("watch", ["--policy", "expert"]),
        ("record", ["--out", "demos.pt"]),
        ("train", ["--offline", "--data", "random"]),
    ],
)
def test_an_environment_of_gymnasium_has_no_expert_and_no_data(
    tmp_path, monkeypatch, command, options
):
    monkeypatch.chdir(tmp_path)
    env_id = register()
    message = f"^an environment of torch_panda is needed here, but {env_id} is one of"
    with pytest.raises(SystemExit, match=message) as stop:
        main([command, "--env-id", env_id, *options])
    assert "\n" not in str(stop.value)


def test_random_data_depend_on_the_seed_alone():
    env_id = register()

    def make_data(seed, num_envs):
        return generate(
            env_id,
            kind="random",
            transitions=4 * MAX_STEPS,
            seed=seed,
            num_envs=num_envs,
        )

    data = make_data(5, 2)
    assert data.shape == (4, MAX_STEPS)
    assert sha256(data) == sha256(make_data(5, 3)) != sha256(make_data(6, 2))
    following = data["next", "observation"][:, :-1]
    assert torch.equal(data["observation"][:, 1:], following)
    assert (data["observation"][:, :, TIME] == torch.arange(MAX_STEPS)).all()


@pytest.mark.parametrize("ends", ["success", "failure"])
def test_data_of_episodes_that_end_early_are_refused(ends):
    with pytest.raises(ValueError, match="ends episodes before their time limit"):
        generate(register(ends=ends), kind="random", transitions=1, seed=0, num_envs=2)


def test_data_of_episodes_without_a_time_limit_are_refused():
    env_id = register(max_episode_steps=None)
    with pytest.raises(ValueError, match=f"{env_id} .* has no max_episode_steps"):
        generate(env_id, kind="random", transitions=1, seed=0, num_envs=2)
