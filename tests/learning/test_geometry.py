"""Layout and symmetry that agents assume hold in the physics of the tasks."""

import re
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize

import torch_panda
from tests.ids import TASK_IDS
from torch_panda.experts.cube_orientations import (
    STRAIGHT,
    compose,
    straighten,
    to_matrix,
)
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.environments.geometry import (
    declares_layout,
    find_geometry,
    probe,
    read_geometry,
)
from torch_panda.rotations import rotation_distance
from torch_panda.tasks import OBJECT_LAYOUT, GoalEntries

MIRROR_POSE = torch.tensor([1, -1, 1, -1, 1, -1, 1], dtype=torch.float64)
MIRROR_VELOCITY = torch.tensor([1, -1, 1, -1, 1, -1], dtype=torch.float64)


TASKS = ["Reach", "Push", "Slide", "PickAndPlace", "Stack", "Flip"]


@pytest.mark.parametrize("task", [*TASKS, "Drawer", "PegInsertion"])
def test_mirrored_starts_and_actions_give_mirrored_episodes(task):
    """The arm moves, and the objects tumble through the air above it."""
    generator = torch.Generator().manual_seed(0)
    with torch_panda.make(f"Panda{task}-v1", num_envs=2, seed=3) as env:
        geometry = read_geometry(env)
        assert geometry.action is not None
        state = env.reset().update(env.get_state())
        pose, velocity = state["object_pose"], state["object_velocity"]
        pose[0] = torch.randn(pose[0].shape, generator=generator)
        pose[0, :, 3:] /= pose[0, :, 3:].norm(dim=-1, keepdim=True)
        pose[0, :, 2] += 20.0
        velocity[0] = torch.randn(velocity[0].shape, generator=generator)
        pose[1], velocity[1] = pose[0] * MIRROR_POSE, velocity[0] * MIRROR_VELOCITY
        if "object_joint_position" in state.keys():  # noqa: SIM118 (a TensorDict)
            state["object_joint_position"][1] = state["object_joint_position"][0]
        goal = state["desired_goal"]
        goal[1] = goal[0] * torch.tensor(geometry.goal)
        td = env.reset(state, set_state=True)
        for _ in range(10):
            action = 0.2 * torch.randn(len(geometry.action), generator=generator)
            action[1] += 0.1  # out of the plane
            td["action"] = torch.stack((action, action * torch.tensor(geometry.action)))
            td = env.step(td)["next"]
            one, mirrored = td["observation"]
            one = one * torch.tensor(geometry.observation)
            arm = env.robot.observation_dim
            if task == "Flip":  # a quaternion and its negative are one orientation
                quaternion = slice(arm + 3, arm + 7)
                one[quaternion] *= (one[quaternion] @ mirrored[quaternion]).sign()
            # The hand is rotated by 0.3 degrees out of the plane, which causes these
            # errors [m, m/s] at velocities of up to 0.5 m/s.
            error = (mirrored - one).abs()
            assert error[:3].max() < 0.01
            assert error[:arm].max() < 0.05
            assert one[1].abs() > 1e-3  # not in the plane itself
            torch.testing.assert_close(mirrored[arm:], one[arm:], atol=1e-4, rtol=0)


@pytest.mark.parametrize("task", ["Push", "PickAndPlace", "Stack"])
def test_differences_lead_from_hand_to_object_and_object_to_goal(task):
    with torch_panda.make(f"Panda{task}-v1", num_envs=3, seed=0) as env:
        td = env.reset()
        result = read_geometry(env).differences(td["observation"], td["desired_goal"])
        objects = td["achieved_goal"].unflatten(-1, (-1, 3))
        goals = td["desired_goal"].unflatten(-1, (-1, 3))
        from_hand = objects - td["observation"][:, None, :3]
        expected = torch.cat((from_hand, goals - objects), 1).flatten(1)
        torch.testing.assert_close(result, expected)


def test_numbers_of_a_stack_belong_to_their_cubes():
    with torch_panda.make("PandaStack-v1", num_envs=1) as env:
        geometry = read_geometry(env)
    inputs, offsets = geometry.owners()
    # Hand and fingers, two cubes, and two goals. The cubes are at 7 and at 19.
    first, second = 7, 19
    goals = [first] * 3 + [second] * 3
    assert inputs == [None] * 7 + [first] * 12 + [second] * 12 + goals
    assert offsets == goals * 2  # from the hand to the cubes, from the cubes to goals
    # If an object comes first, then the hand, and then another object:
    inputs, _ = replace(geometry, positions=(7, 0, 19)).owners()
    assert inputs[:31] == [0] * 7 + [None] * 12 + [19] * 12


def test_numbers_of_reach_belong_to_no_object():
    with torch_panda.make("PandaReach-v1", num_envs=1) as env:
        assert read_geometry(env).owners() == ([None] * 9, [None] * 3)


def test_rotations_are_the_same_for_the_24_orientations_that_look_alike():
    generator = torch.Generator().manual_seed(0)
    with torch_panda.make("PandaFlip-v1", seed=0) as env:
        geometry = read_geometry(env)
    columns = slice(geometry.orientation, geometry.orientation + 4)
    observation = torch.randn(20, 20, generator=generator)
    goal = normalize(torch.randn(20, 4, generator=generator), dim=-1)
    cube = observation[:, columns] = normalize(observation[:, columns], dim=-1)
    seen, to_goal, matrix, similarity = geometry.rotations(observation, goal)
    # The rotation leads from the cube to the goal, and none of the 24 is smaller.
    torch.testing.assert_close(matrix, to_matrix(to_goal).flatten(-2))
    torch.testing.assert_close(
        matrix.view(20, 3, 3) @ to_matrix(cube), to_matrix(goal), atol=1e-5, rtol=0
    )
    others = compose(cube[:, None], STRAIGHT)
    torch.testing.assert_close(seen[:, columns][:, 3], others[..., 3].abs().amax(1))
    # Similarity of the goal with each rotation of the cube's straight orientation.
    turned = compose(STRAIGHT, straighten(cube)[:, None])
    left = rotation_distance(turned, goal[:, None]).squeeze(-1)
    torch.testing.assert_close(similarity, 1 - left)
    for same in STRAIGHT:
        alike = observation.clone()
        alike[:, columns] = compose(cube, same)
        again = geometry.rotations(alike, compose(goal, same))
        expected = (seen, to_goal, matrix, similarity)
        torch.testing.assert_close(again, expected, atol=1e-5, rtol=0)


class FlipCan(torch_panda.Flip):
    """The object has a quaternion, but does not look the same in 24 orientations."""

    observation_layout = ("position", "quaternion", "velocity", "angular_velocity")


def test_only_a_cube_looks_the_same_in_24_orientations():
    robot = torch_panda.Panda()
    with torch_panda.RobotTaskEnv(robot=robot, task=FlipCan(), num_envs=2) as env:
        geometry = read_geometry(env)
        assert geometry.orientation is None
        assert geometry.goal == (-1, 1, -1, 1)
        agent = make_agent(env, Hyperparameters(relative_inputs="fine"))
        env.rollout(2, agent.explore)


class Reversed(torch_panda.Push):
    """Observes the numbers of the inherited layout in another order."""

    def observation(self, simulation):
        return super().observation(simulation).flip(-1)


class Planar(torch_panda.Push):
    """Goals are two of the three numbers of a position."""

    goal_dim = 2
    goal_entries = GoalEntries("task", (0, 1))

    def achieved_goal(self, simulation):
        return super().achieved_goal(simulation)[:, :2]


class OneNumberMore(torch_panda.Push):
    """Observes one more number than the layout has that it declares."""

    observation_dim = 13
    observation_layout = OBJECT_LAYOUT
    goal_entries = GoalEntries("task", (0, 1, 2))

    def observation(self, simulation):
        height = simulation.object_pose[:, 0, 2:3]
        return torch.cat((super().observation(simulation), height), 1)


class JointsFirst(torch_panda.Panda):
    """Observes the angles of its joints, and then what every robot does."""

    observation_dim = 13

    def observation(self, simulation):
        angles = simulation.joint_position[:, :7]
        return torch.cat((angles, super().observation(simulation)), 1)


class Posed(torch_panda.Push):
    """Goals are orientation and position."""

    goal_dim = 6
    goal_entries = GoalEntries("task", (3, 4, 5, 0, 1, 2))

    def achieved_goal(self, simulation):
        return self.observation(simulation)[:, self.goal_entries.indices]

    def sample_goal(self, rng):
        return (*super().sample_goal(rng), 0.0, 0.0, 0.0)

    def marker_pose(self, goal):
        return super().marker_pose(goal[..., :3])


@pytest.mark.parametrize("task", [Reversed, Planar, OneNumberMore])
def test_a_declared_layout_must_fit(task):
    robot = torch_panda.Panda(block_gripper=True)
    assert declares_layout(robot, torch_panda.Push())
    assert not declares_layout(robot, task())
    assert not declares_layout(JointsFirst(block_gripper=True), torch_panda.Push())


@pytest.mark.parametrize("exploration", ["actions", "points"])
def test_the_angles_of_a_robot_are_not_taken_for_its_hand(exploration):
    robot = JointsFirst(control_type="joints", block_gripper=True)
    with torch_panda.RobotTaskEnv(
        robot=robot, task=torch_panda.Push(), num_envs=4, seed=0
    ) as env:
        hp = Hyperparameters(relative_inputs="fine", exploration=exploration)
        agent = make_agent(env, hp)
        env.rollout(2, agent.explore)
        assert agent.spaces.geometry.positions == ()


def test_a_goal_is_mirrored_in_its_own_order():
    robot = torch_panda.Panda(block_gripper=True)
    with torch_panda.RobotTaskEnv(robot=robot, task=Posed(), num_envs=1) as env:
        assert read_geometry(env).goal == (-1, 1, -1, 1, -1, 1)


@pytest.mark.parametrize(
    "env_id", [x for x in TASK_IDS if not re.search("Flip|Stack|PegInsertion", x)]
)
def test_the_found_layout_is_the_declared_one(env_id):
    torch.manual_seed(0)
    with torch_panda.make(env_id, num_envs=4, seed=0) as env:
        found, declared = find_geometry(probe(env)), read_geometry(env)
    for name in ("points", "origins", "positions", "goal_positions"):
        assert getattr(found, name) == getattr(declared, name), name


def test_each_object_of_a_stack_is_found_and_a_quaternion_is_no_position():
    for env_id, positions, goals in (
        ("PandaStack-v1", (0, 7, 19), (0, 3)),
        ("PandaFlip-v1", (0,), ()),
    ):
        with torch_panda.make(env_id, num_envs=4, seed=0) as env:
            found = find_geometry(probe(env))
        assert (found.positions, found.goal_positions) == (positions, goals)
