"""The published hashes are those of the data that `generate` makes here."""

import re
from pathlib import Path

import pytest

import torch_panda
from torch_panda import datasets

GUIDE = Path(torch_panda.__file__).parent / "datasets" / "README.md"
SMALL = 1000  # transitions of the data sets that the tests generate


def read_hashes(transitions):
    """The hashes of the table of this size, by id and kind."""
    table = GUIDE.read_text().split(f"sha256 of {transitions:,} transitions |\n")[1]
    rows = re.findall(
        r"^\| `([\w-]+)` \| (\w+) \| .*`([0-9a-f]{64})` \|$",
        table.split("\n\n")[0],
        re.MULTILINE,
    )
    return {(env_id, kind): digest for env_id, kind, digest in rows}


def test_every_task_and_kind_has_a_hash():
    tasks = ("Reach", "Push", "Slide", "PickAndPlace", "Stack", "Flip")
    expected = {
        (f"Panda{task}-v1", kind)
        for task in tasks
        for kind in ("noisy", "play", "random")
    }
    hashes = read_hashes(SMALL)
    assert hashes.keys() == expected
    assert len(set(hashes.values())) == len(hashes)


@pytest.mark.parametrize(
    ("env_id", "kind"),
    [
        ("PandaPush-v1", "noisy"),
        ("PandaReach-v1", "play"),
        ("PandaStack-v1", "random"),
        ("PandaFlip-v1", "noisy"),
    ],
)
def test_a_data_set_has_its_published_hash(env_id, kind):
    data = datasets.generate(env_id, kind=kind, transitions=SMALL, seed=0, num_envs=10)
    assert datasets.sha256(data) == read_hashes(SMALL)[env_id, kind]
