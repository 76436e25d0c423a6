"""Where observations hold the achieved goal, and goals that are full observations."""

import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import check_env_specs

import torch_panda
from tests.ids import PHYSICS_IDS
from torch_panda import Panda, Push, Reach, RobotTaskEnv
from torch_panda.tasks import GoalEntries, ObjectState
from torch_panda.transforms import HindsightRelabel

# One id for each robot and task.
IDS = [
    env_id
    for env_id in PHYSICS_IDS
    if "Joints" not in env_id and env_id.endswith("-v1")
]


def make(env_id="PandaPush-v1", **options):
    options = {"num_envs": 3, "seed": 0, "goal": "observation"} | options
    return torch_panda.make(env_id, **options)


# ---- goal_indices --------------------------------------------------------------


class Undeclared(Push):
    """Overrides `observation` without declaring ``goal_entries`` again."""

    def observation(self, simulation):
        return super().observation(simulation).flip(1)


class Flipped(Undeclared):
    goal_entries = GoalEntries("task", (11, 10, 9))


class OtherRobot(Panda):
    def observation(self, simulation):
        return super().observation(simulation).flip(1)


def test_a_declaration_holds_for_the_functions_that_it_describes():
    with RobotTaskEnv(robot=Panda(), task=Undeclared()) as env:
        assert env.goal_indices is None
    with RobotTaskEnv(robot=Panda(), task=Flipped()) as env:
        assert env.goal_indices == (7 + 11, 7 + 10, 7 + 9)
        env.reset()
    with RobotTaskEnv(robot=OtherRobot(), task=Reach()) as env:
        assert env.goal_indices is None


def test_wrong_goal_entries_are_refused():
    short = type("Short", (Push,), {"goal_entries": GoalEntries("task", (0, 1))})
    with pytest.raises(ValueError, match=r"Short.goal_entries must name 3 numbers of"):
        RobotTaskEnv(robot=Panda(), task=short())


# ---- goal="observation" --------------------------------------------------------


@pytest.mark.parametrize("env_id", [*IDS, "PandaPushDense-v1"])
def test_rewards_and_success_stay_those_of_the_task(env_id):
    options = {"num_envs": 2}
    with make(env_id, **options) as env, make(env_id, goal="task", **options) as plain:
        first = env.rollout(5)
        second = plain.rollout(5, policy=_repeat(first["action"]))
        for key in ("observation", "reward", "success", "terminated", "truncated"):
            assert torch.equal(first["next", key], second["next", key])
        step, indices = first["next"], list(env.goal_indices)
        assert torch.equal(step["achieved_goal"], step["observation"])
        assert step["desired_goal"].shape == step["observation"].shape
        desired = step["desired_goal"][..., indices]
        assert torch.equal(desired, second["next", "desired_goal"])
        goals = step["achieved_goal"], step["desired_goal"]
        assert torch.equal(env.compute_reward(*goals), step["reward"])
        assert torch.equal(env.is_success(*goals), step["success"])
        assert env.is_success(goals[1], goals[1]).all()


def _repeat(actions):
    steps = iter(actions.unbind(1))
    return lambda td: td.set("action", next(steps))


@pytest.mark.parametrize(
    "task", ["Push", "PickAndPlace", "Stack", "Flip", "Drawer", "PegInsertion"]
)
def test_a_desired_goal_is_the_observation_of_a_reached_goal(task):
    """Bullet observes the same numbers when it is reset to the goal."""
    with make(f"Panda{task}-v1") as env:
        desired, state = env.reset()["desired_goal"], env.get_state()
        goal, joints = state["desired_goal"], state.get("object_joint_position", None)
        objects = ObjectState(state["object_pose"], joints)
        objects = env.task.objects_at_goal(goal, objects)
        state["object_pose"] = objects.pose
        if joints is not None:
            state["object_joint_position"] = objects.joint_position
        del state["joint_position"], state["joint_velocity"]
        reached = env.reset(state, set_state=True)
        assert reached["success"].all()
        if task == "Flip":  # q and -q are one rotation
            quaternion = reached["observation"][:, 10:14]
            quaternion *= (quaternion * goal).sum(1, keepdim=True).sign()
        torch.testing.assert_close(reached["observation"], desired, rtol=0, atol=1e-6)


def test_in_reach_the_hand_is_at_the_goal():
    with make("PandaReach-v1") as env:
        desired = env.reset()["desired_goal"]
        assert torch.equal(desired[:, :3], env.get_state()["desired_goal"].float())
        assert not desired[:, 3:].any()


def test_a_turned_cube_touches_the_table():
    with make("PandaFlip-v1", num_envs=20) as env:
        height = env.reset()["desired_goal"][:, 9]
    assert (height >= 0.02).all() and (height <= 0.02 * 3**0.5 + 1e-6).all()
    assert len(height.unique()) == 20


def test_states_keep_the_goal_of_the_task():
    with make() as env:
        env.rollout(4)
        desired = env.reset()["desired_goal"]
        env.rollout(4, auto_reset=False, tensordict=env.reset())
        for exact in (False, True):
            state = env.get_state(exact=exact)
            assert state["desired_goal"].shape == (3, 3)
            start = env.reset(state, set_state=True)
            goal = start["desired_goal"][:, list(env.goal_indices)]
            assert torch.equal(goal, state["desired_goal"].float())
            assert torch.equal(start["achieved_goal"], start["observation"])
        assert desired.shape == (3, 18)
        moving = env.get_state()
        moving["object_velocity"][:] = 0.1
        desired = env.reset(moving, set_state=True)["desired_goal"]
        assert not desired[:, 12:].any()  # the goal is to be at rest
        only_goal = TensorDict({"desired_goal": torch.zeros(3, 3)}, [3])
        assert not env.reset(only_goal)["desired_goal"][:, 6:].any()


def test_specs_fit_goals_that_are_observations():
    with make(num_envs=2) as env:
        check_env_specs(env)
    with make(num_envs=None, from_pixels=True, pixels_only=True) as env:
        check_env_specs(env)
        assert env.reset()["desired_goal"].shape == (18,)


def test_partial_resets_keep_the_other_goals():
    with make() as env:
        before = env.reset()
        mask = torch.tensor([[False], [True], [False]])
        after = env.reset(before.clone().set("_reset", mask))
        changed = (before["desired_goal"] != after["desired_goal"]).any(1)
        assert changed.tolist() == [False, True, False]


def test_reward_functions_of_full_observations_pickle():
    with make() as env:
        functions = env.compute_reward, env.is_success
    reward, success = pickle.loads(pickle.dumps(functions))
    goals = torch.zeros(2, 5, 18), torch.ones(2, 5, 18)
    assert torch.equal(reward(*goals), -torch.ones(2, 5, 1))
    assert success(goals[0], goals[0]).all()
    with pytest.raises(ValueError, match=r"full observations of shape \(\.\.\., 18\)"):
        reward(torch.zeros(4, 3), torch.zeros(4, 3))


def test_hindsight_relabels_full_observations():
    with make(num_envs=2) as env:
        relabel = HindsightRelabel.from_env(env, her_ratio=1.0, strategy="final")
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(100), transform=relabel, batch_size=64
        )
        rollout = env.rollout(50)
        rollout["collector", "traj_ids"] = torch.arange(2)[:, None].expand(2, 50)
        buffer.extend(rollout.reshape(-1))
        batch = buffer.sample()
        last = rollout["next", "achieved_goal"][:, -1]
        goals = batch["desired_goal"]
        assert (goals[:, None] == last).all(-1).any(-1).all()
        expected = env.compute_reward(batch["next", "achieved_goal"], goals)
        assert torch.equal(batch["next", "reward"], expected)
        assert (batch["next", "reward"] == 0).any()


def test_tasks_without_goal_entries_refuse_observations_as_goals():
    with pytest.raises(ValueError, match="but Undeclared has no goal_entries"):
        RobotTaskEnv(robot=Panda(), task=Undeclared(), goal="observation")
    with pytest.raises(ValueError, match="goal must be one of"):
        make(goal="pixels")


class TwoObjects(Push):
    """Has two objects, but a goal of one position."""

    observation_dim = 24
    goal_entries = GoalEntries("task", (0, 1, 2))

    def build(self, client):
        bodies = super().build(client)
        other = client.create_sphere(0.02, mass=1.0, position=(0.2, 0.2, 0.02))
        return bodies._replace(objects=(*bodies.objects, other))

    def sample_objects(self, rng):
        (cube,) = super().sample_objects(rng)
        return (cube, (0.2, 0.2, 0.02, 0, 0, 0, 1))

    def observation(self, simulation):
        return simulation.object_state.flatten(1)

    def achieved_goal(self, simulation):
        return simulation.object_pose[:, 0, :3]


def test_a_task_of_another_form_says_where_its_objects_are():
    with pytest.raises(ValueError, match=r"needs TwoObjects\.objects_at_goal"):
        RobotTaskEnv(robot=Panda(), task=TwoObjects(), goal="observation")


def test_goal_entries_of_an_unknown_part_are_refused():
    entries = GoalEntries("objects", (0, 1, 2))
    task = type("Wrong", (Push,), {"goal_entries": entries})()
    with pytest.raises(ValueError, match=r"part of goal_entries must be .*'objects'"):
        RobotTaskEnv(robot=Panda(), task=task)
