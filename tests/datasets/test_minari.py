"""Minari data sets: others read them, and episodes start again."""

from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
import torch

import torch_panda
from tests.datasets.recording import record
from torch_panda.datasets import read_demos
from torch_panda.experts import make_expert

minari = pytest.importorskip(
    "minari", reason="needs the extra minari, which takes Python 3.11 or newer"
)

EPISODES = 3


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The root of Minari's data sets, and the id of one of Push."""
    root, dataset_id = tmp_path_factory.mktemp("minari"), "panda/push-expert-v0"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        record("minari", dataset_id, "PandaPush-v1", EPISODES, seed=5)
        yield root, dataset_id


@pytest.mark.filterwarnings("ignore:.*out of date")
def test_episodes_start_again_from_id_and_seed(recorded):
    dataset = minari.load_dataset(recorded[1])
    metadata = list(dataset.storage.get_episode_metadata(range(EPISODES)))
    assert [episode["seed"] for episode in metadata] == [5, 6, 7]
    env = dataset.recover_environment()
    assert env.spec.id == "torch_panda/PandaPush-v1"
    for episode, found in zip(dataset, metadata, strict=True):
        state, info = env.reset(seed=found["seed"])
        steps = [(state, info["is_success"])]
        for action in episode.actions:
            state, reward, terminated, truncated, info = env.step(action)
            steps.append((state, info["is_success"]))
        assert (episode.terminations[-1], episode.truncations[-1]) == (False, True)
        assert (terminated, truncated, reward) == (False, True, episode.rewards[-1])
        for key, values in episode.observations.items():
            np.testing.assert_array_equal(values, [state[key] for state, _ in steps])
        success = [success for _, success in steps]
        np.testing.assert_array_equal(episode.infos["is_success"], success)
        assert success[-1]
    env.close()


def test_demonstrations_of_minari_are_those_that_were_recorded(recorded):
    folder, expert = recorded[0] / recorded[1], make_expert("PandaPush-v1")
    with torch_panda.make("PandaPush-v1", num_envs=1) as env:
        demos, episodes = read_demos(folder, env), []
        for seed in (5, 6, 7):
            env.set_env_seed(0, seed)
            episodes.append(env.rollout(50, expert)[0])
    expected = torch.cat(episodes)
    for key in demos.exclude("collector").keys(include_nested=True, leaves_only=True):
        assert torch.equal(demos[key], expected[key]), key
    success = demos["next", "success"]
    assert success.any() and not success.all()


def test_torchrl_reads_a_minari_data_set_offline(recorded, tmp_path):
    from torchrl.data.datasets.minari_data import MinariExperienceReplay

    replay = MinariExperienceReplay(
        recorded[1], batch_size=16, root=tmp_path, load_from_local_minari=True
    )
    assert len(replay) == EPISODES * 50
    batch = replay.sample()
    goals = [batch["next", "observation", f"{x}_goal"] for x in ("achieved", "desired")]
    reward = torch_panda.Push().compute_reward(*goals)
    assert torch.equal(reward, batch["next", "reward"].float())


def test_bad_names_of_minari_data_sets_are_refused(recorded):
    for name, message in (
        (recorded[1], "already"),
        ("push", "'push' is not an id of .*: it must end in a version"),
        ("x/y-v0", "'x/y-v0' is not an id of .* a namespace must have at least two"),
        (
            "panda/x.y-v0",
            "'panda/x.y-v0' is not an id of .* as in panda/push-expert-v0",
        ),
    ):
        with pytest.raises(SystemExit, match=message):
            record("minari", name, "PandaReach-v1", 1)


def test_ctrl_c_leaves_no_incomplete_data_set(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupt = Mock(side_effect=KeyboardInterrupt)
        patch.setattr("minari.utils.MinariDataset", interrupt)
        record("minari", "panda/reach-v0", "PandaReach-v1", 1)
    record("minari", "panda/reach-v0", "PandaReach-v1", 1)
    assert len(minari.load_dataset("panda/reach-v0")) == 1


def collect(env_id):
    """Two random episodes, in the entries that Minari's `DataCollector` writes.

    By default, a `DataCollector` stores no infos. Tests do not use it, because it needs
    jax.
    """
    env = gymnasium.make(f"torch_panda/{env_id}", max_episode_steps=6)
    buffers = []
    for seed in range(2):
        states, steps, ended = [env.reset(seed=seed)[0]], [], False
        while not ended:
            action = np.random.default_rng(seed).uniform(-1, 1, 3).astype(np.float32)
            state, *outcome, _ = env.step(action)
            states.append(state)
            steps.append((action, *outcome))
            ended = outcome[1] or outcome[2]
        actions, rewards, terminations, truncations = map(
            list, zip(*steps, strict=True)
        )
        buffers.append(
            minari.data_collector.EpisodeBuffer(
                id=seed,
                seed=seed,
                observations={key: [x[key] for x in states] for key in states[0]},
                actions=actions,
                rewards=rewards,
                terminations=terminations,
                truncations=truncations,
                infos={},
            )
        )
    name = "panda/collected-v0"
    minari.create_dataset_from_buffers(name, buffers, env=env, data_format="hdf5")
    env.close()
    return minari.storage.get_dataset_path(name)


def read(path, env_id):
    with torch_panda.make(env_id, num_envs=1) as env:
        return read_demos(path, env)


MISSING_METADATA = pytest.mark.filterwarnings("ignore::UserWarning")


@MISSING_METADATA
def test_data_of_minaris_collector_are_read(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    path = collect("PandaReach-v1")
    demos = read(path, "PandaReach-v1")
    assert len(demos) == 12
    success = demos["next", "reward"] == 0
    assert torch.equal(demos["next", "success"], success)
    (episode, _) = minari.load_dataset("panda/collected-v0")
    observed = torch.from_numpy(episode.observations["observation"])
    assert torch.equal(demos["next", "observation"][:6], observed[1:])


@MISSING_METADATA
def test_data_of_another_environment_are_refused_by_id(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    path = collect("PandaPush-v1")
    message = "was recorded in PandaPush-v1, but the environment is PandaSlide-v1"
    with pytest.raises(ValueError, match=message):
        read(path, "PandaSlide-v1")
    assert len(read(path, "PandaPush-v1"))


@MISSING_METADATA
def test_a_data_set_of_another_library_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episode = minari.data_collector.EpisodeBuffer(
        id=0,
        observations=np.zeros((3, 4)),
        actions=np.zeros(2, int),
        rewards=np.zeros(2),
        terminations=np.zeros(2, bool),
        truncations=np.ones(2, bool),
    )
    spec = gymnasium.spec("CartPole-v1")
    minari.create_dataset_from_buffers(
        "cart/pole-v0", [episode], env=spec, data_format="hdf5"
    )
    path = tmp_path / "cart" / "pole-v0"
    with (
        torch_panda.make("PandaReach-v1", num_envs=1) as env,
        pytest.raises(ValueError, match=f"^{path} does not hold demonstrations: "),
    ):
        read_demos(path, env)
