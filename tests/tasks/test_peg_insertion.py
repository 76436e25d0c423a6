"""PegInsertion: the grasp, the width of the hole, and success."""

import pytest
import torch

import torch_panda
from torch_panda import PegInsertion

N = 3


def hold_still(env, td, steps):
    for _ in range(steps):
        td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
    return td


def release_over_hole(env, offset, height, steps=25):
    """Release the peg over the hole; the last output after some steps.

    Args:
        env: An environment with batch size [N].
        offset: Offset from the centre of the hole along x and y [m].
        height: Height of the peg's lower end [m].
        steps: Number of steps.
    """
    env.reset()
    state = env.get_state()
    hole = state["object_pose"][:, 1, :3]
    peg = state["object_pose"][:, 0]
    peg[:, :2] = hole[:, :2] + torch.tensor(offset, dtype=torch.float64)
    peg[:, 2] = height + 0.04
    return hold_still(env, env.reset(state, set_state=True), steps)


def test_the_hand_holds_the_peg():
    with torch_panda.make("PandaPegInsertion-v1", num_envs=N, seed=0) as env:
        td = env.reset()
        start = td["achieved_goal"]
        end = hold_still(env, td, 49)["achieved_goal"]
        assert (end - start).norm(dim=1).max() < 0.002
        action = torch.tensor((0.1, -0.1, 0.1)).expand(N, 3)
        td = env.reset()
        for _ in range(15):
            td = env.step(td.set("action", action))["next"]
        moved = td["achieved_goal"] - td["observation"][:, :3]
        assert (moved - torch.tensor((0.0, 0.0, -0.06))).norm(dim=1).max() < 0.003


@pytest.mark.parametrize("clearance", [0.001, 0.0005])
def test_the_hole_is_wider_than_the_peg_by_the_clearance(clearance):
    options = {"clearance": clearance}
    with torch_panda.make(
        "PandaPegInsertion-v1", num_envs=N, seed=0, task_options=options
    ) as env:
        inside = release_over_hole(env, (0.4 * clearance, -0.4 * clearance), 0.052)
        assert (inside["achieved_goal"][:, 2] < 0.045).all()
        on_top = release_over_hole(env, (0.7 * clearance + 0.001, 0.0), 0.052)
        assert (on_top["achieved_goal"][:, 2] > 0.045).all()


def test_only_a_peg_in_the_hole_is_a_success():
    with torch_panda.make("PandaPegInsertion-v1", num_envs=N, seed=0) as env:
        deep = release_over_hole(env, (0.0, 0.0), 0.015, steps=0)
        assert deep["success"].all()
        # The goal is 3 cm below the top of the block, which is 5 cm high.
        goal = deep["desired_goal"]
        hole = deep["observation"][:, -3:]
        torch.testing.assert_close(goal, hole + torch.tensor((0.0, 0.0, 0.02)))
        on_top = goal + torch.tensor((0.0, 0.0, 0.03))
        beside = goal + torch.tensor((0.02, 0.0, 0.0))
        for end in (on_top, beside):
            assert not env.is_success(end, goal).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clearance": 0.03}, "clearance must be between"),
        ({"depth": 0.06}, "depth must be from distance_threshold"),
        ({"depth": 0.005}, "depth must be from distance_threshold"),
    ],
)
def test_peg_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        PegInsertion(**options)


def test_blocked_fingers_keep_the_width_of_the_robot():
    for width in (0.0, 0.03):
        robot_options = {"fingers_width": width}
        with torch_panda.make("PandaReach-v1", robot_options=robot_options) as env:
            td = env.reset()
            for _ in range(3):
                fingers = env.get_state()["joint_position"][7:].sum().item()
                assert fingers == pytest.approx(width, abs=1e-4)
                td = env.step(td.set("action", torch.ones(3)))["next"]
    with pytest.raises(ValueError, match="fingers_width must be from 0"):
        torch_panda.Panda(fingers_width=0.1)
