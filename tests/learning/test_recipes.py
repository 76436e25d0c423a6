"""The recipe, and the options of the panda-gym paper.

The table recipes.json has the options of both. To accept changed options, write it
again, and read its difference:

    python -m tests.learning.test_recipes
"""

import json
import re
from dataclasses import asdict
from functools import partial
from pathlib import Path

import pytest

import torch_panda
from tests.learning.test_geometry import JointsFirst, OneNumberMore, Posed
from torch_panda.learning.agents import make_agent
from torch_panda.learning.limits import check_limits
from torch_panda.learning.options import Args, default_args
from torch_panda.learning.training import Run
from torch_panda.tasks import GoalEntries

TABLE = Path(__file__).with_name("recipes.json")
# The ids that stand for their task in the table.
PANDA = [
    env_id
    for env_id in torch_panda.ENV_IDS
    if env_id.startswith("Panda") and not re.search("Joints|Dense", env_id)
]


def to_json(args):
    """Options as they are written into a JSON file."""
    return json.loads(json.dumps(asdict(args), default=str))


def read_recipe(env_id):
    """The options of the recipe that differ from those of the paper."""
    options, paper = (to_json(default_args(x, env_id)) for x in ("recipe", "paper"))
    assert options.pop("preset") == "recipe"
    return {key: value for key, value in options.items() if value != paper[key]}


def find_task(env_id):
    """The task and version of an id, such as "Push-v1", for any robot and reward."""
    name = re.sub(r"^(Panda|Kuka|XArm6Gripper|XArm6)", "", env_id)
    return re.sub("(Joints)?(Dense)?-", "-", name)


def write_table():
    """Write the options of the paper, and the recipe's changes by task."""
    changes = {find_task(env_id): read_recipe(env_id) for env_id in PANDA}
    lines = [f'"{task}": {json.dumps(x)}' for task, x in changes.items()]
    recipe = '"recipe": {\n ' + ",\n ".join(lines) + "\n}"
    TABLE.write_text(f'{{"paper": {json.dumps(to_json(Args()))},\n{recipe}}}\n')


def test_the_options_of_recipe_and_paper_are_those_of_the_table():
    table = json.loads(TABLE.read_text())
    assert to_json(Args()) == table["paper"]
    for env_id in torch_panda.ENV_IDS:
        assert default_args("paper", env_id) == Args(env_id=env_id)
        expected = dict(table["recipe"][find_task(env_id)])
        if "Joints" in env_id:  # it needs end-effector control
            expected.pop("augmentation", None)
        assert read_recipe(env_id) == expected, env_id
        check_limits(default_args("recipe", env_id))


@pytest.mark.usefixtures("quick")
def test_the_recipe_fits_joint_control(tmp_path):
    args = default_args("recipe", "PandaFlipJointsDense-v3")
    args.num_envs, args.total_steps = 2, 100
    Run(args, tmp_path).close()


@pytest.mark.usefixtures("quick")
def test_episodes_that_start_in_the_middle_of_the_task_are_shorter(tmp_path):
    """An episode of Stack lasts 100 steps otherwise."""
    args = default_args("recipe", "PandaStack-v1")
    args.num_envs = 2
    run = Run(args, tmp_path)
    data = next(iter(run.source.collector))
    run.close()
    assert data.shape == (2, 50)


@pytest.mark.usefixtures("quick")
def test_three_full_evaluations_in_a_row_end_a_training(tmp_path):
    args = default_args("recipe", "PandaReach-v1")
    args.num_envs = 2
    run = Run(args, tmp_path)
    for success, is_finished in (
        ((1.0, 1.0), False),
        ((1.0, 0.9, 1.0, 1.0), False),
        ((0.0, 1.0, 1.0, 1.0), True),
    ):
        run.progress.curve = [{"success": x} for x in success]
        assert run.is_finished() == is_finished
    args.stop_when_solved = False
    assert not run.is_finished()
    run.close()


@pytest.mark.parametrize(
    ("control_type", "exploration"),
    [("ee", "points"), ("joints", "points"), ("joint_velocity", "actions")],
)
def test_the_recipe_fits_tasks_and_robots_of_users(control_type, exploration):
    robot = partial(torch_panda.Panda, control_type=control_type, block_gripper=True)
    torch_panda.register("OneNumberMore-v0", robot=robot, task=OneNumberMore)
    args = default_args("recipe", "OneNumberMore-v0")
    assert (args.augmentation, args.exploration) == ("none", exploration)
    with torch_panda.make("OneNumberMore-v0", num_envs=args.num_envs, seed=0) as env:
        agent = make_agent(env, args)
        assert agent.spaces.geometry.positions == (0, 6)
        env.rollout(2, agent.explore)


class PosedFlip(torch_panda.Flip):
    """Goals are position and quaternion."""

    goal_dim = 7
    goal_entries = GoalEntries("task", tuple(range(7)))

    def achieved_goal(self, simulation):
        return simulation.object_pose[:, 0]

    def sample_goal(self, rng):
        return (0.0, 0.0, 0.0, *super().sample_goal(rng))

    def marker_pose(self, goal):
        return goal.unsqueeze(-2)


@pytest.mark.parametrize("task", [Posed, PosedFlip])
def test_a_pose_is_the_goal_of_one_object(task):
    robot = partial(torch_panda.Panda, block_gripper=True)
    torch_panda.register("Posed-v0", robot=robot, task=task)
    args = default_args("recipe", "Posed-v0")
    assert (args.her, args.critics) == ("relabel", "whole")
    with torch_panda.make("Posed-v0", num_envs=args.num_envs, seed=0) as env:
        env.rollout(2, make_agent(env, args).explore)


def test_the_recipe_fits_a_robot_with_an_observation_of_its_own():
    robot = partial(JointsFirst, block_gripper=True)
    torch_panda.register("JointsFirst-v0", robot=robot, task=torch_panda.Push)
    args = default_args("recipe", "JointsFirst-v0")
    assert (args.augmentation, args.exploration) == ("none", "actions")


def test_the_discount_of_a_short_episode_is_positive():
    for steps in (1, 2):
        torch_panda.register(
            "Short-v0",
            robot=torch_panda.Panda,
            task=torch_panda.Reach,
            max_episode_steps=steps,
        )
        check_limits(default_args("recipe", "Short-v0"))


if __name__ == "__main__":
    write_table()
