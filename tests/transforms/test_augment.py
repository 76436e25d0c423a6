import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from tests.devices import DEVICES
from tests.transforms.identifiable import (
    STORED_REWARD,
    Envs,
    check_batch,
    relabelled,
    reward_fn,
    terminated_fn,
)
from torch_panda.transforms import HindsightAugment


def make_buffer(
    capacity=10_000, buffer=TensorDictReplayBuffer, device="cpu", **options
):
    return buffer(
        storage=LazyTensorStorage(capacity, device=device),
        transform=HindsightAugment(reward_fn, **options),
        batch_size=64,
    )


@pytest.mark.parametrize("layout", ["env_first", "time_first", "rows", "no_ids"])
def test_each_transition_of_an_ended_episode_is_stored_with_k_copies(layout):
    k, strategy = 3, "future"
    rb = make_buffer(strategy=strategy, k=k)
    envs, written = Envs(4, [1, 5, 12]), []
    for steps in (3, 1, 7, 2) * 2:
        data = envs.chunk(steps)
        written.append(data.reshape(-1))
        if layout == "no_ids":
            data = data.exclude("collector")
        elif layout != "rows":
            data = (data if layout == "env_first" else data.transpose(0, 1)).reshape(-1)
        rb.extend(data)
    stored, written = rb.storage[:], torch.cat(written)["next", "achieved_goal"]
    check_batch(stored, stored, strategy, her_ratio=k / (k + 1))

    open_episodes = {(i, int(e)) for i, e in enumerate(envs.episode)}
    ended = [row for row in written.tolist() if (row[0], row[1]) not in open_episodes]
    mask = relabelled(stored)
    achieved = stored["next", "achieved_goal"]
    assert sorted(achieved[~mask].tolist()) == sorted(ended)
    assert sorted(achieved[mask].tolist()) == sorted(ended * k)
    assert (stored["next", "reward"][~mask] == STORED_REWARD).all()


@pytest.mark.parametrize("data_device", DEVICES)
@pytest.mark.parametrize("storage_device", DEVICES)
def test_copies_are_on_the_device_of_the_storage(data_device, storage_device):
    rb = make_buffer(device=storage_device, strategy="future")
    envs = Envs(3, [5, 9])
    for _ in range(2):
        rb.extend(envs.chunk(10).reshape(-1).to(data_device))
    stored = rb.storage[:]
    assert stored["desired_goal"].device.type == storage_device
    assert relabelled(stored).any()
    check_batch(stored.cpu(), stored.cpu(), "future")


def test_nothing_is_stored_until_an_episode_ends():
    rb, envs = make_buffer(k=1), Envs(2, [6])
    for _ in range(5):
        rb.extend(envs.chunk(1))
        assert len(rb) == 0
    rb.extend(envs.chunk(1))
    assert len(rb) == 2 * 6 * 2


def test_terminated_is_rewritten_in_the_copies():
    rb = make_buffer(k=2, terminated_fn=terminated_fn)
    rb.extend(Envs(2, [4]).chunk(8))
    stored = rb.storage[:]
    mask = relabelled(stored)[:, None]
    reached = terminated_fn(stored["next", "achieved_goal"], stored["desired_goal"])
    assert (stored["next", "terminated"] == (reached & mask)).all()
    done = stored["next", "terminated"] | stored["next", "truncated"]
    assert (stored["next", "done"] == done).all()


@pytest.mark.parametrize("how", ["state_dict", "dumps"])
def test_held_episodes_are_saved(how, tmp_path):
    rb, envs = make_buffer(k=2, seed=1), Envs(3, [5, 8])
    for _ in range(3):
        rb.extend(envs.chunk(3).reshape(-1))
    new = make_buffer(k=2, seed=1)
    if how == "dumps":
        rb.dumps(tmp_path)
        new.loads(tmp_path)
    else:
        new.load_state_dict(rb.state_dict())
    more = envs.chunk(8).reshape(-1)
    for buffer in (rb, new):
        buffer.extend(more)
    assert (rb.storage[:] == new.storage[:]).all()


def test_empty_drops_the_held_episodes():
    rb, envs = make_buffer(), Envs(1, [6])
    rb.extend(envs.chunk(3))
    rb.empty()
    rb.transform[0].empty()
    rb.extend(envs.chunk(3))
    assert set(rb.storage[:]["next", "achieved_goal"][:, 2].tolist()) == {4, 5, 6}


@pytest.mark.parametrize(("layout", "rooted"), [("rows", True), ("no_ids", False)])
def test_augmentation_keeps_trajectories_with_equal_ids_apart(layout, rooted):
    """Collectors in turn, each of which leaves episodes unfinished."""
    rb, written = make_buffer(k=2, strategy="episode"), []
    for i in range(4):
        envs = Envs(3, [7], first_env=10 * i)
        for _ in range(5):
            data = envs.chunk(2)
            written += data["next", "achieved_goal"].reshape(-1, 3).tolist()
            data = data.exclude("collector") if layout == "no_ids" else data.reshape(-1)
            rb.extend(data if rooted else data.exclude("achieved_goal"))
        if not rooted:
            rb.transform[0].end_trajectories()
    stored = rb.storage[:]
    check_batch(stored, stored, "episode", her_ratio=2 / 3)
    kept = stored["next", "achieved_goal"][~relabelled(stored)].tolist()
    unfinished = [row for row in written if row[0] >= 30 and row[1] == 1]
    assert sorted(kept + unfinished) == sorted(written)


def test_adding_one_by_one_raises():
    rb, data = make_buffer(k=2), Envs(1, [4]).chunk(4)[0]
    with pytest.raises(ValueError, match="use `extend`"):
        rb.add(data[0])
    for step in range(4):
        rb.extend(data[step : step + 1])
    assert len(rb) == 3 * 4


def test_augmentation_ignores_the_default_device():
    data = Envs(3, [5]).chunk(10)
    with torch.device("meta"):
        stored = HindsightAugment(reward_fn, seed=0)._inv_call(data)
    check_batch(stored, stored, "future")
