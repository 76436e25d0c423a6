"""Recording demonstrations: what the file holds, and that a stop loses nothing."""

import pytest
import torch
from tensordict import TensorDict

from torch_panda.commands import record as record_demos
from torch_panda.experts import make_expert


def test_every_episode_has_its_number(tmp_path, capsys):
    out = tmp_path / "new" / "folder" / "demos.pt"
    record_demos.main(record_demos.Args("PandaPush-v3", 6, num_envs=4, out=out))
    assert "success at the end" in capsys.readouterr().out
    demonstrations = TensorDict(torch.load(out)).auto_batch_size_(1)
    ids = demonstrations["collector", "traj_ids"]
    assert ids.unique().tolist() == list(range(6))
    last = demonstrations["next", "done"].squeeze(-1)
    assert ids[last].tolist() == list(range(6))


def test_the_saved_action_is_the_one_without_noise(tmp_path):
    out = tmp_path / "demos.pt"
    args = record_demos.Args("PandaReach-v1", 2, num_envs=2, noise_eps=0.3, out=out)
    record_demos.main(args)
    demos = TensorDict(torch.load(out)).auto_batch_size_(1)
    saved = demos["action"].clone()
    torch.testing.assert_close(make_expert(args.env_id)(demos)["action"], saved)
    # What was executed is another one: the hand went elsewhere.
    moved = demos["next", "observation"][:, :3] - demos["observation"][:, :3]
    assert ((moved / 0.05 - saved)[10:50].abs() > 0.3).any()


def test_the_seed_determines_the_noise(tmp_path):
    # The hand and the goal are always at the same place, so only the noise is random.
    files = []
    for index, seed in enumerate((0, 0, 1)):
        args = record_demos.Args("PandaReach-v1", 2, seed, noise_eps=0.3)
        args.task_options = {"goal_range": 0.0}
        args.out = tmp_path / f"{index}.pt"
        record_demos.main(args)
        files.append(torch.load(args.out)["next"]["observation"])
    assert torch.equal(files[0], files[1])
    assert not torch.equal(files[0][0], files[2][0])


def test_options_of_the_task_can_be_changed(capsys):
    args = record_demos.Args("PandaReach-v1", 4, num_envs=4)
    for threshold, success in ((0.5, "100.0%"), (1e-9, "  0.0%")):
        args.task_options = {"distance_threshold": threshold}
        record_demos.main(args)
        assert f"success at the end   {success}" in capsys.readouterr().out
    args.task_options = {"threshold": 1.0}
    with pytest.raises(SystemExit, match=r"accepted are .*distance_threshold"):
        record_demos.main(args)


@pytest.mark.parametrize("kind", ["expert", "random"])
def test_an_existing_file_is_not_overwritten(tmp_path, kind):
    out = tmp_path / "data.pt"
    out.write_text("precious")
    options = {"transitions": 50} if kind == "random" else {"episodes": 1}
    args = record_demos.Args("PandaReach-v1", kind=kind, out=out, **options)
    with pytest.raises(SystemExit, match=r"data\.pt exists already: remove it, or"):
        record_demos.main(args)
    assert out.read_text() == "precious"
