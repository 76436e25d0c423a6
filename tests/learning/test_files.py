"""Files of a run: damaged ones are refused, and a full disk leaves the old ones."""

import json
import math
import random
import resource
from contextlib import contextmanager

import pytest
import torch

import torch_panda
from torch_panda.commands import train
from torch_panda.learning import files
from torch_panda.learning.files.run_files import write_options
from torch_panda.learning.options import Args
from torch_panda.learning.plots import plot_curve
from torch_panda.policies import shipped_policies

REACH = shipped_policies()["PandaReach-v1"]


@contextmanager
def full_disk(size):
    """Let no file of this process grow beyond a size [bytes]."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def equal(one, other):
    """Whether two contents of files are the same, bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[k], other[k]) for k in one)
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    return one == other


def test_one_flipped_bit_never_changes_a_policy(tmp_path):
    """The file is refused, or the bit is one that nothing reads."""
    content, path = torch.load(REACH), tmp_path / "policy.pt"
    data, rng = REACH.read_bytes(), random.Random(0)
    refused = 0
    for _ in range(60):
        damaged = bytearray(data)
        damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            torch_panda.load_policy(path)
        except ValueError as error:
            assert str(path) in str(error)
            assert "\n" not in str(error)
            refused += 1
        else:
            assert equal(torch.load(path), content)
    assert refused > 30


@pytest.mark.parametrize("number", [math.nan, math.inf])
@pytest.mark.parametrize("part", ["policy", "hyperparameters"])
def test_policies_with_numbers_that_are_not_finite_are_refused(tmp_path, part, number):
    content = torch.load(REACH)
    if part == "policy":
        content[part]["actor"]["module.0.0.weight"][3, 2] = number
    else:
        content[part]["noise_eps"] = number
    path = tmp_path / "policy.pt"
    torch.save(content, path)
    message = rf"^{path} does not hold a policy, .* \({part} has numbers that are not"
    with pytest.raises(ValueError, match=message):
        torch_panda.load_policy(path)


@pytest.mark.usefixtures("quick")
def test_a_state_with_numbers_that_are_not_finite_is_not_resumed(tmp_path):
    args = Args(total_steps=100, num_envs=2, video=False, out=tmp_path / "run")
    args.updates_per_step = 0.02
    train.main(args)
    state = torch.load(args.out / "resume.pt")
    weights = state["agent"]["actor.0.0.weight"]
    weights[0, 0] = math.nan
    torch.save(state, args.out / "resume.pt")
    args.resume = True
    with pytest.raises(
        SystemExit, match=r"resume\.pt .*agent has numbers that are not"
    ):
        train.main(args)


WRITERS = {
    "numbers.pt": lambda path: files.save(path, torch.zeros(100_000)),
    "text.txt": lambda path: files.save_text(path, "x" * 100_000),
    "curve.png": lambda path: plot_curve(
        [{"step": 0, "success": 0}], "Reach", path, xlabel="steps"
    ),
    "args.json": lambda path: write_options(path.parent, Args(), Args()),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_old_file_and_no_other(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"old")
    message = f"^cannot write {name} into {tmp_path}: "
    with full_disk(200), pytest.raises(OSError, match=message) as error:
        WRITERS[name](path)
    assert "\n" not in str(error.value)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    WRITERS[name](path)
    assert path.read_bytes() != b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("quick")
def test_a_training_on_a_full_disk_ends_with_one_line(tmp_path):
    out = tmp_path / "run"
    with full_disk(10_000), pytest.raises(SystemExit) as stop:
        train.main(Args(total_steps=100, num_envs=1, out=out))
    assert str(stop.value).startswith(f"cannot write resume.pt into {out}: ")
    assert "\n" not in str(stop.value)
    # Nothing is left that would keep the next training from this folder.
    assert {path.name for path in out.iterdir()} == {"args.json", "run.lock"}
    assert json.loads((out / "args.json").read_text())["env_id"] == "PandaReach-v1"


def test_a_killed_writer_leaves_the_old_file(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")

    def killed(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        files.replace(path, killed)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
