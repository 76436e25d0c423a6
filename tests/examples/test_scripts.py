"""The scripts that teach: each runs."""

import subprocess
import sys
from pathlib import Path

import custom_pipeline
import dense_ppo
import gallery
import numpy as np
import own_task
import panda_gym_judge
import parallel
import pixels
import pytest
import sb3
import torch
from PIL import Image
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda.learning.environments.geometry import find_geometry, probe
from torch_panda.learning.user_modules import import_modules
from torch_panda.testing import check_task
from torch_panda.transforms import HindsightRelabel

ROOT = Path(__file__).parents[2]


FIRST = ROOT / "examples" / "first_steps.py"


def test_the_first_script_is_short_and_trains(capsys):
    """With one batch of episodes instead of six, and few episodes of evaluation."""
    source = FIRST.read_text()
    assert len(source.splitlines()) <= 60
    for old, new in (("2_400", "400"), ("num_envs=50", "num_envs=2")):
        assert source.count(old) == 1
        source = source.replace(old, new)
    names = {"__name__": "first_steps"}
    exec(compile(source.replace("range(200)", "range(20)"), FIRST, "exec"), names)
    assert capsys.readouterr().out.startswith("400 steps: success at the end of 50")
    start, end = names["buffer"][:], names["buffer"].storage[:]
    changed = (start["desired_goal"] != end["desired_goal"]).any(-1)
    assert 0.6 < changed.float().mean() < 0.9


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_first_script_learns_reach():
    command = [sys.executable, FIRST]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    lines = [line for line in run.stdout.splitlines() if "steps: success" in line]
    assert lines[-1] == "2400 steps: success at the end of 50 episodes 100%"


def test_ppo_lowers_the_distance_from_the_goal(monkeypatch, capsys):
    monkeypatch.setattr(dense_ppo, "TOTAL_STEPS", 4_800)
    monkeypatch.setattr(dense_ppo, "evaluate", lambda *_: 0.0)
    dense_ppo.main()
    lines = [x for x in capsys.readouterr().out.splitlines() if "mean reward" in x]
    rewards = [float(line.split()[4].rstrip(",")) for line in lines]
    assert len(rewards) == 6
    assert rewards[-1] > 0.8 * rewards[0]  # rewards are negative


def test_hindsight_learns_a_small_grid(monkeypatch):
    monkeypatch.setattr(custom_pipeline, "SIZE", 10)
    monkeypatch.setitem(custom_pipeline.STEPS, "total_frames", 1_500)
    monkeypatch.setattr(custom_pipeline, "UPDATES_PER_BATCH", 100)
    assert custom_pipeline.main() > 0.5


@pytest.mark.slow
def test_hindsight_learns_the_grid_and_plain_dqn_does_not(monkeypatch):
    assert custom_pipeline.main() > 0.8
    monkeypatch.setattr(custom_pipeline, "HER_RATIO", 0.0)
    assert custom_pipeline.main() < 0.1


def test_training_changes_the_policy_from_pixels(monkeypatch):
    make_env = pixels.make_env
    monkeypatch.setattr(pixels, "make_env", lambda seed, _: make_env(seed, 2))
    monkeypatch.setattr(pixels, "STEPS", {"frames_per_batch": 100, "total_frames": 100})
    monkeypatch.setattr(pixels, "UPDATES_PER_BATCH", 5)
    before, after = pixels.main()
    assert abs(before - after) > 0.001  # in the same episodes


def test_the_policy_from_pixels_sees_picture_and_goal():
    actor = pixels.PixelActor()
    pictures = torch.randint(0, 256, (2, 48, 48, 3), dtype=torch.uint8)
    goals = torch.rand(2, 3)
    action = actor(pictures, goals)
    assert action.shape == (2, 3)
    for other in (actor(pictures.flip(0), goals), actor(pictures, goals.flip(0))):
        assert ((action - other).abs() > 1e-4).any()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_policy_from_pixels_learns_reach():
    _, after = pixels.main()
    assert after < 0.1


def test_own_task_is_a_valid_environment():
    with torch_panda.make("PushBall-v0", num_envs=2, seed=0) as env:
        check_env_specs(env)
        assert env.render(0, size=32).shape == (32, 32, 3)


def test_the_arm_of_own_task_moves_the_balls():
    assert (own_task.main() > 0.005).all()


@pytest.mark.parametrize(
    ("name", "env_id", "num_objects"),
    [
        ("ball", "Ball-v0", 1),
        ("two_cubes", "TwoCubes-v0", 2),
        ("lever", "Lever-v0", 1),
        ("xarm_box", "XArmBox-v0", 1),
        ("xarm_box", "KukaBox-v0", 1),
    ],
)
def test_the_layout_of_each_own_task_is_found(name, env_id, num_objects):
    import_modules([str(ROOT / "examples" / "own_tasks" / f"{name}.py")])
    check_task(env_id)
    with torch_panda.make(env_id, num_envs=4, seed=0) as env:
        geometry = find_geometry(probe(env))
    assert len(geometry.positions) == 1 + num_objects
    assert geometry.goal_positions == tuple(3 * k for k in range(num_objects))


def test_workers_run_different_episodes():
    goals = parallel.roll_out().reshape(-1, 3)
    assert len(goals.unique(dim=0)) == parallel.NUM_WORKERS * parallel.NUM_ENVS


def test_a_buffer_of_worker_processes_is_relabelled(monkeypatch):
    monkeypatch.setattr(parallel, "TOTAL_STEPS", 800)
    buffer = parallel.collect()
    assert len(buffer) == 800
    assert isinstance(buffer.transform[0], HindsightRelabel)
    stored, batch = buffer.storage[:], buffer.sample()
    goals = batch["desired_goal"], stored["desired_goal"][batch["index"]]
    assert not torch.equal(*goals)


def test_the_script_of_stable_baselines3_trains(monkeypatch, capsys):
    monkeypatch.setattr(sb3, "TOTAL_STEPS", 800)
    monkeypatch.setattr(sb3, "EPISODES", 4)
    evaluate, reached = sb3.evaluate, []

    def evaluate_and_sample(model):
        reached.append((model.replay_buffer.sample(500).rewards == 0).float().mean())
        return evaluate(model)

    monkeypatch.setattr(sb3, "evaluate", evaluate_and_sample)
    sb3.main()
    assert reached[0] > 0.15  # a quarter; without hindsight, one row in a hundred
    output = capsys.readouterr().out
    assert "actor_loss" in output and "success_rate" in output
    assert "800 steps: success at the end of 4 episodes" in output


def test_every_cell_of_the_gallery_succeeds(monkeypatch, tmp_path):
    monkeypatch.setattr(gallery, "NUM_FRAMES", 2)
    monkeypatch.setattr(gallery, "CELL", (60, 48))
    path = tmp_path / "gallery.webp"
    gallery.main(path)
    with Image.open(path) as picture:
        assert picture.n_frames == 2
        picture.seek(1)
        pixels = np.asarray(picture.convert("RGB"))
    assert pixels.shape == (2 * 48, 4 * 60, 3)
    corners = pixels[1::48, 1::60].astype(int)  # of each cell's frame
    assert (abs(corners - gallery.GREEN) < 20).all()


def test_the_gallery_refuses_an_episode_that_fails(monkeypatch):
    def rest(td):
        return td.set("action", torch.zeros(1, 3))

    monkeypatch.setattr(gallery, "draw", lambda *_: None)
    monkeypatch.setattr(gallery.torch_panda, "load_policy", lambda _: rest)
    with pytest.raises(ValueError, match="Slide fails with seed 3"):
        gallery.play("Slide")


def test_panda_gym_judges_as_our_own_environments_do(capsys):
    ours = torch_panda.evaluate(
        torch_panda.load_policy("PandaReach-v1"), "PandaReach-v3", episodes=30
    )
    result = panda_gym_judge.main("PandaReach-v1", "PandaReach-v3", episodes=30)
    assert "success at the end   100.0%  [88.6%, 100.0%]" in capsys.readouterr().out
    assert result.success_rate == ours.success_rate == 1.0
    # Each step without success costs 1, in both.
    assert torch.equal(result.returns, 1.0 - result.lengths)
    assert abs(result.mean_length - ours.mean_length) < 1
    assert len(result.lengths.unique()) > 1  # the episodes differ
