"""Goals and objects at the start of episodes fill the published ranges."""

import numpy as np
import pytest

from torch_panda.registry import find_registration

NUM_DRAWS = 1000
SQUARE = ((-0.15, 0.15), (-0.15, 0.15))  # x and y [m]
FIXED = (0.02, 0.02)  # height of a cube on the table [m]

# Lowest and highest x, y and z of the goals [m].
GOALS = {
    "PandaReach-v1": (*SQUARE, (0.0, 0.3)),
    "PandaReach-v3": (*SQUARE, (0.0, 0.3)),
    "PandaPush-v1": (*SQUARE, FIXED),
    "PandaPush-v3": (*SQUARE, FIXED),
    "PandaSlide-v1": ((0.26, 0.76), (-0.25, 0.25), (0.03, 0.03)),
    "PandaSlide-v3": ((0.25, 0.55), (-0.15, 0.15), (0.03, 0.03)),
    "PandaPickAndPlace-v1": (*SQUARE, (0.02, 0.22)),
    "PandaPickAndPlace-v3": (*SQUARE, (0.02, 0.22)),
    "PandaStack-v1": (*SQUARE, FIXED, *SQUARE, (0.06, 0.06)),
    "PandaStack-v3": (*SQUARE, FIXED, *SQUARE, (0.06, 0.06)),
    "PandaPegInsertion-v1": ((-0.1, 0.1), (-0.1, 0.1), (0.02, 0.02)),
}
# The same of the objects.
OBJECTS = {
    "PandaPush-v1": [(*SQUARE, FIXED)],
    "PandaSlide-v1": [(*SQUARE, (0.03, 0.03))],
    "PandaSlide-v3": [(*SQUARE, (0.03, 0.03))],
    "PandaPickAndPlace-v3": [(*SQUARE, FIXED)],
    "PandaStack-v1": [(*SQUARE, FIXED), (*SQUARE, (0.06, 0.06))],
    "PandaFlip-v1": [(*SQUARE, FIXED)],
}


def draw(env_id):
    task, rng = find_registration(env_id).make_task(), np.random.default_rng(0)
    return [task.sample_start(rng) for _ in range(NUM_DRAWS)]


def assert_fills(values, ranges):
    """Assert that values (n, k) reach the ends of k ranges to 1 %, and stay inside."""
    low, high = np.transpose(ranges)
    margin = 0.01 * (high - low) + 1e-9
    np.testing.assert_array_less(abs(values.min(0) - low), margin)
    np.testing.assert_array_less(abs(values.max(0) - high), margin)
    assert (values >= low - 1e-9).all() and (values <= high + 1e-9).all()


@pytest.mark.parametrize("env_id", GOALS)
def test_goals_fill_the_published_box(env_id):
    assert_fills(np.array([start.goal for start in draw(env_id)]), GOALS[env_id])


@pytest.mark.parametrize("env_id", OBJECTS)
def test_objects_fill_the_published_square(env_id):
    poses = np.array([start.object_pose for start in draw(env_id)])
    for index, ranges in enumerate(OBJECTS[env_id]):
        assert_fills(poses[:, index, :3], ranges)
    assert (poses[..., 3:] == (0, 0, 0, 1)).all()


@pytest.mark.parametrize("env_id", ["PandaPickAndPlace-v1", "PandaPickAndPlace-v3"])
def test_30_percent_of_the_goals_of_pick_and_place_are_on_the_table(env_id):
    heights = np.array([start.goal[2] for start in draw(env_id)])
    on_table = heights == 0.02
    assert on_table.mean() == pytest.approx(0.3, abs=0.04)
    # The others are spread evenly over the height.
    assert heights[~on_table].mean() == pytest.approx(0.12, abs=0.01)


def test_both_cubes_of_a_stack_have_their_goals_at_one_point():
    goals = np.array([start.goal for start in draw("PandaStack-v1")])
    assert (goals[:, :2] == goals[:, 3:5]).all()


def test_flips_goals_are_spread_evenly_over_all_orientations():
    goals = np.array([start.goal for start in draw("PandaFlip-v1")])
    np.testing.assert_allclose(np.linalg.norm(goals, axis=1), 1.0)
    np.testing.assert_allclose(goals.T @ goals / NUM_DRAWS, np.eye(4) / 4, atol=0.03)
