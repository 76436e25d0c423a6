"""Recording demonstrations: what the file holds, and that a stop loses nothing."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import record_demos
import torch_panda
from evaluate import wilson_interval
from experts import make_expert
from torch_panda.transforms import HindsightRelabel


def test_demonstrations_extend_a_replay_buffer(tmp_path, capsys):
    out = tmp_path / "demos.pt"
    record_demos.main(record_demos.Args("PandaPush-v3", 6, num_envs=4, out=out))
    assert "success at the end" in capsys.readouterr().out
    demonstrations = TensorDict(torch.load(out)).auto_batch_size_(1)
    ids = demonstrations["collector", "traj_ids"]
    assert ids.unique().tolist() == list(range(6))
    last = demonstrations["next", "done"].squeeze(-1)
    assert ids[last].tolist() == list(range(6))

    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(1000),
        transform=HindsightRelabel(torch_panda.Push().compute_reward, seed=0),
        batch_size=64,
    )
    buffer.extend(demonstrations)
    batch = buffer.sample()
    assert batch["desired_goal"].shape == (64, 3)
    assert (batch["next", "reward"] == 0).any()


def test_what_is_saved_is_the_action_without_noise(tmp_path):
    out = tmp_path / "demos.pt"
    args = record_demos.Args("PandaReach-v1", 2, num_envs=2, noise_eps=0.3, out=out)
    record_demos.main(args)
    demos = TensorDict(torch.load(out)).auto_batch_size_(1)
    saved = demos["action"].clone()
    torch.testing.assert_close(make_expert(args.env_id)(demos)["action"], saved)
    # What was executed is another one: the hand went elsewhere.
    moved = demos["next", "observation"][:, :3] - demos["observation"][:, :3]
    assert ((moved / 0.05 - saved)[10:50].abs() > 0.3).any()


def test_only_successful_episodes_are_saved_if_wanted(tmp_path):
    out = tmp_path / "demos.pt"
    args = record_demos.Args("PandaFlip-v1", 12, num_envs=12, seed=1, out=out)
    for successful in (False, True):
        args.successful = successful
        record_demos.main(args)
        demos = TensorDict(torch.load(out)).auto_batch_size_(1)
        ended = demos["next", "success"][demos["next", "done"]]
        assert ended.all() == successful
    assert 0 < len(ended) < 12
    assert demos["collector", "traj_ids"].unique().tolist() == list(range(len(ended)))


def stop(*arguments):
    raise KeyboardInterrupt


@pytest.mark.parametrize("during", ["play", "join"])
def test_ctrl_c_leaves_the_file_as_it_was(tmp_path, monkeypatch, during):
    out = tmp_path / "demos.pt"
    args = record_demos.Args("PandaReach-v3", episodes=2, num_envs=2, out=out)
    record_demos.main(args)
    before = out.read_bytes()
    monkeypatch.setattr(record_demos, during, stop)
    with pytest.raises(SystemExit, match=r"^stopped$"):
        record_demos.main(args)
    assert out.read_bytes() == before


def test_ctrl_c_while_writing_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    out = tmp_path / "demos.pt"
    out.write_bytes(b"before")

    def write_half(content, path):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", write_half)
    args = record_demos.Args("PandaReach-v3", episodes=2, num_envs=2, out=out)
    with pytest.raises(SystemExit, match=r"^stopped$"):
        record_demos.main(args)
    assert out.read_bytes() == b"before"


def test_wilson_interval():
    # The textbook value for 8 of 10.
    low, high = wilson_interval(8, 10)
    assert low == pytest.approx(0.490, abs=1e-3)
    assert high == pytest.approx(0.943, abs=1e-3)
