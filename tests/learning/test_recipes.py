"""The recipes of --preset tuned."""

import pytest

import torch_panda
from torch_panda.learning.limits import check_limits
from torch_panda.learning.options import Args, default_args
from torch_panda.learning.recipes import RECIPES, find_recipe
from torch_panda.learning.training import Run


@pytest.mark.parametrize("task", RECIPES)
def test_recipes_are_options(task):
    args = default_args("tuned", f"Panda{task}-v1")
    check_limits(args)
    assert args.preset == "tuned"
    assert args != Args(preset="tuned", env_id=args.env_id)


def test_every_task_has_a_recipe():
    for env_id in torch_panda.ENV_IDS:
        assert find_recipe(env_id)
    push = RECIPES["Push"]
    assert find_recipe("PandaPush-v1") == find_recipe("PandaPushDense-v3") == push
    assert find_recipe("PandaPickAndPlace-v1") != push


@pytest.mark.parametrize(
    "env_id", ["PandaPickAndPlaceJoints-v1", "PandaFlipJointsDense-v3"]
)
def test_recipes_fit_joint_control(env_id, tmp_path):
    args = default_args("tuned", env_id)
    args.num_envs, args.total_steps = 2, 100
    Run(args, tmp_path).close()


def test_unknown_tasks_and_the_paper_have_none():
    assert find_recipe("PandaFly-v1") == find_recipe("Fly-v1") == {}
    assert find_recipe("BallPush-v0") == {}  # somebody's own
    assert default_args("paper", "PandaPush-v1") == Args(env_id="PandaPush-v1")


@pytest.mark.parametrize(("ratio", "steps"), [(0.0, 100), (0.5, 50)])
def test_episodes_that_begin_in_the_course_of_the_task_are_shorter(
    ratio, steps, tmp_path
):
    args = default_args("tuned", "PandaStack-v1")
    args.num_envs, args.start_at_object = 2, ratio
    run = Run(args, tmp_path)
    data = next(iter(run.collector))
    run.close()
    assert data.shape == (2, steps)
