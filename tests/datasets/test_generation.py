"""Generated data sets: their content, and that the arguments determine it."""

import pytest
import torch

import torch_panda
from torch_panda import datasets
from torch_panda.datasets import generation

KINDS = ["noisy", "play", "random"]


@pytest.fixture(autouse=True)
def short_play(monkeypatch):
    monkeypatch.setattr(generation, "PLAY_STEPS", 120)


def generate(kind, *, env_id="PandaReach-v3", num_envs=3, transitions=130, **options):
    return datasets.generate(
        env_id, kind=kind, transitions=transitions, seed=7, num_envs=num_envs, **options
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_hash_depends_on_the_recipe_alone(kind):
    expected = datasets.sha256(generate(kind))
    assert datasets.sha256(generate(kind, num_envs=1, num_threads=1)) == expected
    assert datasets.sha256(generate(kind, num_envs=8, num_threads=2)) == expected
    other = datasets.generate(
        "PandaReach-v3", kind=kind, transitions=130, seed=8, num_envs=3
    )
    assert datasets.sha256(other) != expected


@pytest.mark.parametrize(("kind", "steps"), [("noisy", 50), ("play", 120)])
def test_episodes_are_whole_and_never_end_early(kind, steps):
    data = generate(kind)
    assert data.shape == (-(-130 // steps), steps)
    after = data["next"]
    assert after["success"].any()
    assert not after["terminated"].any()
    assert after["done"][:, -1].all()
    assert not after["done"][:, :-1].any()
    torch.testing.assert_close(
        after["observation"][:, :-1], data["observation"][:, 1:], rtol=0, atol=0
    )


class LowReach(torch_panda.Reach):
    """Reach that fails where the hand leaves the lower part of its workspace."""

    def failure(self, simulation):
        return simulation.ee_position[:, 2:] > 0.2


def test_a_failure_does_not_end_an_episode():
    torch_panda.register(
        "LowReach-v0", robot=torch_panda.Panda, task=LowReach, max_episode_steps=50
    )
    data = generate("random", env_id="LowReach-v0")
    assert (data["next", "observation"][..., 2] > 0.2).any()
    after = data["next"]
    assert not after["terminated"].any()
    assert after["done"][:, -1].all()
    assert not after["done"][:, :-1].any()


def test_an_episode_depends_on_its_number_alone():
    few, many = generate("noisy", transitions=50), generate("noisy", transitions=250)
    assert datasets.sha256(few) == datasets.sha256(many[:1])
    starts = many["observation"][:, 0]
    assert len(many["desired_goal"][:, 0].unique(dim=0)) == len(starts)


def test_the_noise_of_an_episode_has_a_scale_of_its_own():
    data = generate("noisy", env_id="PandaPush-v1", transitions=400, num_envs=8)
    expert = torch_panda.experts.make_expert("PandaPush-v1")
    intended = expert(data.exclude("next"))["action"]
    difference = (data["action"] - intended).std(dim=1).mean(dim=1)
    assert (difference.max() > 3 * difference.min()) & (difference.max() < 0.6)


def test_play_pursues_goal_after_goal():
    data = generate("play", num_envs=2)
    goals = data["desired_goal"]
    assert torch.equal(goals, data["next", "desired_goal"])
    for episode in goals:
        assert len(episode.unique(dim=0)) >= 4
    achieved = data["next", "achieved_goal"]
    env_reward = torch_panda.Reach().compute_reward(achieved, goals)
    assert torch.equal(data["next", "reward"], env_reward)
    assert data["next", "success"].float().mean() > 0.4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "expert"}, "kind must be one of noisy, play, random, got 'expert'"),
        ({"kind": "noisy", "env_id": "KukaReach-v1"}, "no expert for"),
        ({"kind": "random", "transitions": 0}, "transitions must be"),
        ({"kind": "noisy", "goal": "observation"}, "leave out goal='observation'"),
        ({"kind": "play", "max_episode_steps": 50}, "max_episode_steps must be 120"),
        ({"kind": "random", "terminate_on_success": True}, "must be False .* random"),
        (
            {"kind": "play", "env_id": "PandaPegInsertion-v1"},
            "needs goals that do",
        ),
    ],
)
def test_wrong_arguments_of_generate_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        generate(**options)
