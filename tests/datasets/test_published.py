"""The published hashes are those of the data that `record --verify` makes here."""

import json
from itertools import product

import pytest

from torch_panda.commands import record

SIZES = ("1000", "100000", "1000000")
TASKS = ("Reach", "Push", "Slide", "PickAndPlace", "Stack", "Flip")
KINDS = ("noisy", "play", "random")


def verify(env_id, kind="expert"):
    record.main(record.Args(verify=True, env_id=env_id, kind=kind, num_envs=10))


def test_every_size_task_and_kind_has_a_hash():
    published = json.loads(record.PUBLISHED.read_text())
    hashes = {
        published[size][f"Panda{task}-v1"][kind]
        for size, task, kind in product(SIZES, TASKS, KINDS)
    }
    assert len(hashes) == len(SIZES) * len(TASKS) * len(KINDS)
    assert all(len(digest) == 64 for digest in hashes)


@pytest.mark.parametrize(
    ("env_id", "kind"),
    [
        ("PandaPush-v1", "noisy"),
        ("PandaSlide-v1", "noisy"),
        ("PandaStack-v1", "random"),
        ("PandaFlip-v1", "noisy"),
    ],
)
def test_a_data_set_has_its_published_hash(env_id, kind, capsys):
    verify(env_id, kind)
    assert f"{env_id} {kind}, 1000 transitions" in capsys.readouterr().out


def test_verify_takes_all_kinds_by_default(capsys):
    verify("PandaReach-v1")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1].strip(",") for line in lines] == list(KINDS)
    assert all(line.endswith("as published") for line in lines)


def test_verify_fails_if_a_hash_differs(tmp_path, monkeypatch):
    published = json.loads(record.PUBLISHED.read_text())
    published["1000"]["PandaReach-v1"]["random"] = 64 * "0"
    path = tmp_path / "published.json"
    path.write_text(json.dumps(published))
    monkeypatch.setattr(record, "PUBLISHED", path)
    with pytest.raises(SystemExit, match="differs from the published one: random"):
        verify("PandaReach-v1", "random")
