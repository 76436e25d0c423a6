"""Recipes of --preset tuned and --preset sample-efficient."""

from dataclasses import replace
from functools import partial

import pytest

import torch_panda
from torch_panda.commands import train
from torch_panda.learning.limits import check_limits
from torch_panda.learning.options import Args, default_args
from torch_panda.learning.recipes import (
    CHANGES_IF_SUCCESS_ENDS,
    RECIPES,
    SAMPLE_EFFICIENT,
    find_recipe,
)
from torch_panda.learning.training import Run


@pytest.mark.parametrize("preset", ["tuned", "sample-efficient"])
@pytest.mark.parametrize("task", RECIPES)
def test_recipes_are_valid_options(task, preset):
    args = default_args(preset, f"Panda{task.__name__}-v1")
    check_limits(args)
    assert args.preset == preset
    assert args != Args(preset=preset, env_id=args.env_id)


def test_the_sample_efficient_recipe_changes_the_tuned_recipe():
    tuned = default_args("tuned", "PandaPickAndPlace-v1")
    args = default_args("sample-efficient", "PandaPickAndPlace-v1")
    assert (args.exploration, args.network) == ("points", "layer-norm")
    assert args.updates_per_step == 4 * tuned.updates_per_step
    assert tuned.start_at_object > args.start_at_object == 0
    assert args.relative_inputs == tuned.relative_inputs == "fine"
    # Without special starts, random grasps on -v3 rarely hold the cube.
    args = default_args("sample-efficient", "PandaPickAndPlace-v3")
    assert args.start_at_object == tuned.start_at_object


def test_every_task_has_a_recipe():
    for env_id in torch_panda.ENV_IDS:
        assert find_recipe(env_id)
    changes = CHANGES_IF_SUCCESS_ENDS[torch_panda.Slide]
    slide = RECIPES[torch_panda.Slide]
    assert find_recipe("PandaSlide-v3") == {**slide, **changes} != slide


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    "env_id", ["PandaPickAndPlaceJoints-v1", "PandaFlipJointsDense-v3"]
)
def test_recipes_fit_joint_control(env_id, tmp_path):
    args = default_args("tuned", env_id)
    args.num_envs, args.total_steps = 2, 100
    Run(args, tmp_path).close()


class PushBall(torch_panda.Push):
    """A task of a user."""


@pytest.mark.usefixtures("quick")
def test_tasks_of_users_have_no_recipe_unless_they_are_shipped_tasks(tmp_path, capsys):
    blocked = partial(torch_panda.Panda, block_gripper=True)
    torch_panda.register("PushBall-v0", robot=blocked, task=PushBall)
    assert find_recipe("PushBall-v0") == {}
    assert find_recipe("PushBall-v0", "sample-efficient") == SAMPLE_EFFICIENT
    default = Args(preset="tuned", env_id="PushBall-v0")
    assert default_args("tuned", "PushBall-v0") == default
    near = partial(torch_panda.Push, goal_xy_range=0.1)
    torch_panda.register("PushNear-v0", robot=blocked, task=near)
    assert find_recipe("PushNear-v0") == RECIPES[torch_panda.Push]
    small = {"total_steps": 50, "num_envs": 1, "video": False}
    train.main(replace(default, **small, out=tmp_path / "run"))
    message = "PushBall-v0 has no recipe: using the options of the panda-gym paper"
    assert message in capsys.readouterr().out


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(("ratio", "steps"), [(0.0, 100), (0.5, 50)])
def test_episodes_that_start_in_the_middle_of_the_task_are_shorter(
    ratio, steps, tmp_path
):
    args = default_args("tuned", "PandaStack-v1")
    args.num_envs, args.start_at_object = 2, ratio
    run = Run(args, tmp_path)
    data = next(iter(run.collector))
    run.close()
    assert data.shape == (2, steps)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("continues", [False, True])
def test_training_episodes_can_go_on_after_success(continues, tmp_path):
    args = Args(env_id="PandaReach-v3", num_envs=16, continue_after_success=continues)
    run = Run(args, tmp_path)
    after = next(iter(run.collector))["next"]
    run.close()
    assert after["success"].any()
    assert after["terminated"].any() != continues
    assert run.curve.env.terminate_on_success
