"""Bad files end a command with one line, and nothing is lost."""

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import torch_panda
from torch_panda.commands import evaluate, train, watch
from torch_panda.commands import record as record_demos
from torch_panda.datasets.demonstrations import read_demos
from torch_panda.learning.evaluation import video


def save(path, content):
    """Write bytes as they are, anything else as torch does; "half" is half a file."""
    if isinstance(content, bytes):
        path.write_bytes(content)
        return
    torch.save({"env_id": "PandaReach-v1"} if content == "half" else content, path)
    if content == "half":
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize(
    "content",
    [b"", b"hello", b"\x80\x02]", "half", {"steps": 1}, [1, 2], TensorDict(x=1)],
    ids=["empty", "text", "pickle", "half", "state", "list", "tensordict"],
)
def test_files_that_hold_no_policy_are_refused(tmp_path, content):
    path = tmp_path / "checkpoint.pt"
    save(path, content)
    message = f"^{path} does not hold a policy, or is damaged \\(.+\\)$"
    with pytest.raises(SystemExit, match=message):
        evaluate.main(evaluate.Args(run=path))


class Intruder:
    """Runs code when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_file_of_a_stranger_runs_no_code(tmp_path):
    path, mark = tmp_path / "demos.pt", tmp_path / "mark"
    torch.save({"observation": Intruder(mark)}, path)
    with (
        torch_panda.make("PandaReach-v1", num_envs=1) as env,
        pytest.raises(ValueError, match="does not hold demonstrations"),
    ):
        read_demos(path, env)
    assert not mark.exists()


# All keys but "cuda_random".
KEYS = (*("args", "agent", "optimizer", "updates", "buffer", "random", "progress"),)
INCOMPLETE = dict.fromkeys(KEYS, 0)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("content", [b"hello", {"args": {}}, INCOMPLETE])
def test_a_damaged_state_of_a_run_is_refused_and_kept(tmp_path, content):
    save(tmp_path / "resume.pt", content)
    before = (tmp_path / "resume.pt").read_bytes()
    message = "resume.pt does not hold the state of a run, or is damaged"
    with pytest.raises(SystemExit, match=message):
        train.main(train.Args(resume=True, out=tmp_path, num_envs=1))
    assert (tmp_path / "resume.pt").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "message"),
    [("file/out.gif", r"^\[Errno .*file"), ("folder.gif", "^cannot write to .*folder")],
)
@pytest.mark.parametrize("script", [record_demos, watch])
def test_an_output_that_cannot_be_written_is_refused_before_playing(
    tmp_path, monkeypatch, script, name, message
):
    monkeypatch.setattr(video if script is watch else script, "play", pytest.fail)
    (tmp_path / "file").touch()
    (tmp_path / "folder.gif").mkdir()
    with pytest.raises(SystemExit, match=message):
        script.main(script.Args(out=tmp_path / name, num_envs=1))
