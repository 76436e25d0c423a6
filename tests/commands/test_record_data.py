"""Recording generated data sets: the files, their hash, and continuing after a stop."""

import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import torch_panda
from torch_panda import datasets
from torch_panda.commands import record
from torch_panda.datasets import generation
from torch_panda.datasets.demonstrations import read_demos
from torch_panda.datasets.parts import Parts

TRANSITIONS = 250


@pytest.fixture(autouse=True)
def short_play(monkeypatch):
    monkeypatch.setattr(generation, "PLAY_STEPS", 120)


def make_args(out, kind="noisy", **options):
    options = {"env_id": "PandaReach-v3", "num_envs": 2, "seed": 7, **options}
    return record.Args(kind=kind, transitions=TRANSITIONS, out=out, **options)


def generate(kind):
    return datasets.generate(
        "PandaReach-v3", kind=kind, transitions=TRANSITIONS, seed=7, num_envs=5
    )


def printed_hash(capsys):
    return re.search(r"sha256 ([0-9a-f]{64})", capsys.readouterr().out)[1]


@pytest.mark.parametrize("kind", ["noisy", "play", "random"])
def test_the_file_holds_the_generated_data(tmp_path, capsys, kind):
    out = tmp_path / "data.pt"
    record.main(make_args(out, kind))
    saved = TensorDict(torch.load(out)).auto_batch_size_(2)
    expected = datasets.sha256(generate(kind))
    assert printed_hash(capsys) == expected == datasets.sha256(saved)
    assert list(tmp_path.iterdir()) == [out]


def stop_after(parts, monkeypatch):
    """Let Ctrl-C arrive when this number of parts is saved."""
    add = record.Parts.add

    def add_and_stop(self, part):
        add(self, part)
        if len(list(self.folder.glob("*.pt"))) == parts:
            raise KeyboardInterrupt

    monkeypatch.setattr(record.Parts, "add", add_and_stop)


def test_a_stopped_data_set_continues_bit_for_bit(tmp_path, capsys, monkeypatch):
    out = tmp_path / "data.pt"
    with monkeypatch.context() as patch:
        stop_after(1, patch)
        with pytest.raises(SystemExit, match="the same command with --resume"):
            record.main(make_args(out))
    assert not out.exists()
    with pytest.raises(SystemExit, match="holds a part of a data set: continue with"):
        record.main(make_args(out))
    with pytest.raises(SystemExit, match="kind was 'noisy' and is now 'random'"):
        record.main(make_args(out, "random", resume=True))
    played = []
    play = record.generate_parts
    with monkeypatch.context() as patch:
        patch.setattr(
            record,
            "generate_parts",
            lambda *args, **options: (
                played.append(len(part)) or part for part in play(*args, **options)
            ),
        )
        record.main(make_args(out, resume=True, num_envs=3))
    assert sum(played) == 3  # two of the five episodes were there
    assert printed_hash(capsys) == datasets.sha256(generate("noisy"))
    assert list(tmp_path.iterdir()) == [out]
    with pytest.raises(SystemExit, match="no data set to resume"):
        record.main(make_args(out, resume=True))


def test_two_processes_do_not_mix_their_parts(tmp_path):
    first, second = (
        Parts(tmp_path / "data.pt.unfinished", {"seed": seed}, resume=False)
        for seed in (0, 1)
    )
    ids = torch.zeros(1, 2, dtype=torch.int64)
    part = TensorDict({"action": ids, "next": {}, ("collector", "traj_ids"): ids})
    first.add(part)
    with pytest.raises(ValueError, match="another process writes into"):
        second.add(part)
    first.add(part)


def test_a_minari_data_set_holds_the_generated_data(tmp_path, capsys, monkeypatch):
    kind = "play"
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    name = f"panda/reach-{kind}-v0"
    with monkeypatch.context() as patch:
        stop_after(1, patch)
        with pytest.raises(SystemExit, match="resume"):
            record.main(make_args(Path(name), kind, format="minari"))
    record.main(make_args(Path(name), kind, format="minari", resume=True))
    expected = generate(kind)
    assert printed_hash(capsys) == datasets.sha256(expected)
    with torch_panda.make("PandaReach-v3") as env:
        read = read_demos(tmp_path / name, env)
    assert torch.equal(
        read["collector", "traj_ids"], expected["collector", "traj_ids"].flatten()
    )
    for key in read.exclude("collector").keys(include_nested=True, leaves_only=True):
        assert torch.equal(read[key], expected[key].flatten(0, 1)), key
    # The seed of an episode starts it again, and the environment lets it finish.
    dataset = minari.load_dataset(name)
    env = dataset.recover_environment()
    metadata = dataset.storage.get_episode_metadata([1])
    episode = dataset[1]
    start, _ = env.reset(seed=next(iter(metadata))["seed"])
    assert (start["desired_goal"] == episode.observations["desired_goal"][0]).all()
    for index, action in enumerate(episode.actions):
        observation, _, terminated, truncated, _ = env.step(action)
        expected_state = episode.observations["observation"][index + 1]
        assert (observation["observation"] == expected_state).all()
    assert (terminated, truncated) == (False, True)
    env.close()
