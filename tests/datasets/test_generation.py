"""Generated data sets: their content, and that the arguments determine it."""

import math

import pytest
import torch

import torch_panda
from tests.datasets.recording import generate, short_play  # noqa: F401 (a fixture)
from torch_panda import datasets

pytestmark = pytest.mark.usefixtures("short_play")


@pytest.mark.parametrize(
    ("kind", "changed"),
    [("noisy", {}), ("play", {}), ("play", {"play_noise": 0.0}), ("random", {})],
)
def test_the_hash_depends_on_the_recipe_alone(kind, changed):
    def sha256(**options):
        return datasets.sha256(generate(kind, **changed, **options))

    expected = sha256()
    assert sha256(num_envs=1, num_threads=1) == expected
    assert sha256(num_envs=8, num_threads=2) == expected
    assert sha256(seed=8) != expected


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


def change(values):
    return ~values if values.dtype == torch.bool else values + 1


def test_the_hash_covers_every_entry():
    data = generate("random", transitions=50)
    keys = list(data.keys(include_nested=True, leaves_only=True))
    hashes = {datasets.sha256(data)}
    for key in keys:
        for new_key, function in (
            (key, change),
            (key, torch.Tensor.double),
            (key, lambda x: x.unsqueeze(-1)),
            ("other", lambda x: x),  # the same values under another name
        ):
            other = data.clone()
            del other[key]
            other[new_key] = function(data[key])
            hashes.add(datasets.sha256(other))
    assert len(hashes) == 1 + 4 * len(keys)
    assert datasets.sha256(data.select(*reversed(keys))) == datasets.sha256(data)


def test_the_noise_of_an_episode_has_a_scale_of_its_own():
    """Standard deviations are uniform from 0 to 0.5."""
    data = generate("noisy", env_id="PandaReach-v1", transitions=2000, num_envs=8)
    expert = torch_panda.experts.make_expert("PandaReach-v1")
    intended = expert(data.exclude("next"))["action"]
    # Close to the goal, the expert's own actions are far from the limits of actions.
    near, difference = intended.abs() < 0.2, data["action"] - intended
    noise = [x[n].std() for x, n in zip(difference, near, strict=True) if n.sum() > 20]
    noise = torch.stack(noise)
    assert len(noise) > 30
    assert noise.min() < 0.08 and 0.38 < noise.max() < 0.55
    assert 0.17 < noise.mean() < 0.33


def test_the_noise_of_play_is_smoothed_over_time():
    """The filter's weights are in proportion to exp(-2 k^2), k steps away."""
    data = generate("play", transitions=2_000, num_envs=8)
    expert = torch_panda.experts.make_expert("PandaReach-v3")
    intended = expert(data.exclude("next"))["action"]
    noise, near = data["action"] - intended, intended.abs() < 0.5  # not clipped
    weights = torch.tensor([math.exp(-8), math.exp(-2), 1, math.exp(-2), math.exp(-8)])
    weights /= weights.sum()
    scale = 0.1 * weights.square().sum().sqrt()
    assert noise[near].std() == pytest.approx(scale.item(), rel=0.05)
    for steps in (1, 2):
        both = near[:, steps:] & near[:, :-steps]
        pairs = torch.stack([noise[:, steps:][both], noise[:, :-steps][both]])
        expected = (weights[steps:] * weights[:-steps]).sum() * (0.1 / scale) ** 2
        correlation = torch.corrcoef(pairs)[0, 1].item()
        assert correlation == pytest.approx(expected.item(), abs=0.05)


def segments(episode, key="desired_goal"):
    """Lengths of the pieces of an episode in which an entry is constant."""
    changes = (episode[key].diff(dim=0) != 0).any(dim=1).nonzero().flatten() + 1
    return changes.diff(prepend=torch.tensor([0]), append=torch.tensor([len(episode)]))


def test_play_stays_at_each_goal():
    """For 10 steps in which the goal is reached; then the next goal comes."""
    data = generate("play", num_envs=2)
    goals, achieved = data["desired_goal"], data["next", "achieved_goal"]
    assert torch.equal(goals, data["next", "desired_goal"])
    reward = torch_panda.Reach().compute_reward(achieved, goals)
    assert torch.equal(data["next", "reward"], reward)
    assert data["next", "success"].float().mean() > 0.4
    for episode in data:
        assert len(episode["desired_goal"].unique(dim=0)) >= 4
        lengths = segments(episode).tolist()
        assert len(lengths) >= 4
        for piece in episode.split(lengths)[:-1]:
            success = piece["next", "success"].squeeze(-1)
            assert success[-10:].all()
            assert len(success) == 10 or not success[-11]


def test_play_gives_up_a_goal_after_the_time_of_an_episode():
    options = {"task_options": {"distance_threshold": 1e-9}}
    for episode in generate("play", num_envs=2, **options):
        assert segments(episode).tolist() == [50, 50, 20]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "expert"}, "kind must be one of noisy, play, random, got 'expert'"),
        ({"kind": "noisy", "env_id": "KukaReach-v1"}, "no expert for"),
        (
            {"kind": "play", "robot_options": {"block_gripper": False}},
            r"no expert for Panda\(.*block_gripper=False",
        ),
        ({"kind": "random", "transitions": 0}, "transitions must be"),
        ({"kind": "noisy", "goal": "observation"}, "leave out goal='observation'"),
        ({"kind": "play", "max_episode_steps": 50}, "max_episode_steps must be 120"),
        ({"kind": "noisy", "play_noise": 0.2}, "play_noise works with the kind play"),
        ({"kind": "random", "device": "cuda"}, "data are generated on the CPU"),
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
