"""Recording generated data sets: the files, their hash, and Ctrl-C."""

import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import torch_panda
from tests.datasets.recording import (
    TRANSITIONS,
    generate,
    short_play,  # noqa: F401 (a fixture)
)
from torch_panda import datasets
from torch_panda.commands import main, record
from torch_panda.datasets.demonstrations import read_demos

pytestmark = pytest.mark.usefixtures("short_play")


def make_args(out, kind="noisy", **options):
    options = {"env_id": "PandaReach-v3", "num_envs": 2, "seed": 7, **options}
    return record.Args(kind=kind, transitions=TRANSITIONS, out=out, **options)


def printed_hash(capsys):
    return re.search(r"sha256 ([0-9a-f]{64})", capsys.readouterr().out)[1]


def test_the_file_holds_the_generated_data(tmp_path, capsys):
    out = tmp_path / "data.pt"
    record.main(make_args(out, "random"))
    saved = TensorDict(torch.load(out)).auto_batch_size_(2)
    expected = datasets.sha256(generate("random"))
    assert printed_hash(capsys) == expected == datasets.sha256(saved)
    assert list(tmp_path.iterdir()) == [out]


def test_ctrl_c_leaves_no_file_and_the_command_can_be_repeated(
    tmp_path, capsys, monkeypatch
):
    arguments = ["record", "--env-id", "PandaReach-v3", "--kind", "noisy"]
    arguments += ["--transitions", str(TRANSITIONS), "--num-envs", "2", "--seed", "7"]
    arguments += ["--out", str(tmp_path / "data.pt")]
    generate_parts = record.generate_parts

    def stop_after_a_part(*args, **options):
        yield next(generate_parts(*args, **options))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(record, "generate_parts", stop_after_a_part)
        with pytest.raises(SystemExit, match=r"^interrupted$"):
            main(arguments)
    assert not list(tmp_path.iterdir())
    main(arguments)
    assert printed_hash(capsys) == datasets.sha256(generate("noisy"))


def test_a_minari_data_set_holds_the_generated_data(tmp_path, capsys, monkeypatch):
    kind = "play"
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    name = f"panda/reach-{kind}-v0"
    record.main(make_args(Path(name), kind, format="minari"))
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
