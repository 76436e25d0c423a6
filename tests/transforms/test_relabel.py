import threading

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    SamplerWithoutReplacement,
    SliceSampler,
)
from torchrl.data.replay_buffers import HERReplayBuffer
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    GymEnv,
    MultiStepTransform,
    TransformedEnv,
)

from tests.devices import DEVICES
from tests.transforms.identifiable import (
    Envs,
    check_batch,
    check_goals,
    check_share,
    check_untouched,
    name_goals,
    relabelled,
    reward_fn,
    terminated_fn,
)
from tests.transforms.pipelines import PHASES, buffer
from torch_panda.transforms import GoalSampler, HindsightRelabel

STRATEGIES = ["future", "final", "episode", "random"]


def make_buffer(capacity=1000, *, ndim=1, sampler=None, batch_size=64, **options):
    transform = HindsightRelabel(reward_fn, **options)
    return buffer(
        transform, capacity=capacity, ndim=ndim, sampler=sampler, batch_size=batch_size
    )


def flatten(data, layout):
    """[N, T] unflattened, without ids, or flattened by environment or by time."""
    if layout in ("none", "no_ids"):
        return data if layout == "none" else data.exclude("collector")
    return (data if layout == "env_first" else data.transpose(0, 1)).reshape(-1)


def is_mixed(batch):
    """Which relabelled rows have another trajectory's goal."""
    other = batch["desired_goal"][..., :2] != batch["next", "achieved_goal"][..., :2]
    return relabelled(batch) & other.any(-1)


@settings(
    max_examples=60,
    deadline=None,
    phases=PHASES,
    suppress_health_check=[HealthCheck.too_slow],
)
@given(
    num_envs=st.integers(1, 7),
    lengths=st.lists(st.integers(1, 30), min_size=1, max_size=4),
    steps=st.lists(st.integers(1, 12), min_size=1, max_size=4),
    capacity=st.integers(8, 200),
    layout=st.sampled_from(["env_first", "time_first", "none", "no_ids"]),
    sampler=st.sampled_from([None, SamplerWithoutReplacement]),
    strategy=st.sampled_from([*STRATEGIES, "current", "geometric"]),
    batch_size=st.sampled_from([1, 7, 64]),
    her_ratio=st.sampled_from([0.5, 0.8, 1.0]),
    every=st.integers(1, 5),
    restart=st.sampled_from([None, 1, 2, 7]),
)
def test_relabelled_goals_are_where_their_strategy_may_draw_them(
    num_envs,
    lengths,
    steps,
    capacity,
    layout,
    sampler,
    strategy,
    batch_size,
    her_ratio,
    every,
    restart,
):
    ndim = 2 if layout in ("none", "no_ids") else 1
    if ndim == 2:  # TensorDictReplayBuffer cannot write a single step there
        steps = [max(2, s) for s in steps]
    capacity = max(capacity, num_envs * max(2, *steps))
    envs = Envs(num_envs, lengths)
    rb = make_buffer(
        capacity,
        ndim=ndim,
        sampler=sampler() if sampler else None,
        strategy=strategy,
        her_ratio=her_ratio,
        batch_size=batch_size,
    )
    masks = []
    # Shows that roots are what the step before achieved.
    rb.extend(flatten(Envs(num_envs, [3], first_env=1000).chunk(2), layout))
    for i in range(25):
        if restart and i % restart == 0:  # a new collector, whose ids begin anew
            envs = Envs(num_envs, lengths, seed=i, first_env=10 * i)
        rb.extend(flatten(envs.chunk(steps[i % len(steps)]), layout))
        if i % every or len(rb) < batch_size:
            continue
        batch = rb.sample()
        stored = rb.storage[:]
        check_batch(batch, stored, strategy, her_ratio)
        check_untouched(batch, stored)
        masks.append(relabelled(batch))
    if masks:
        check_share(torch.cat(masks), her_ratio)  # also of small batches


@pytest.mark.parametrize("layout", ["env_first", "time_first"])
@pytest.mark.parametrize("steps", [1, 10, 50])
def test_no_mixed_goals_where_her_buffer_has_them(layout, steps):
    """Prints the README's shares of goals from other episodes (pytest -s)."""
    torch.manual_seed(0)

    def her_reward(td):
        return reward_fn(td["next", "achieved_goal"], td["desired_goal"])

    envs = Envs(4, [50])
    storage = LazyTensorStorage(5000)
    theirs = HERReplayBuffer(her_reward, storage=storage, batch_size=256)
    ours = make_buffer(5000, batch_size=256)
    mixed = []
    for i in range(200 // steps):
        data = flatten(envs.chunk(steps), layout)
        theirs.extend(data)
        ours.extend(data)
        if i % max(1, 40 // steps) == 0:
            batch = ours.sample()
            check_share(relabelled(batch), 0.8)
            assert not is_mixed(batch).any()
            batch = theirs.sample()
            mixed.append(is_mixed(batch)[relabelled(batch)].float().mean())
    share = float(torch.stack(mixed).mean())
    print(f"{layout}, {steps} steps a batch: HERReplayBuffer mixes {share:.0%}")
    if layout == "env_first" and steps == 50:  # whole episodes
        assert share == 0
    else:
        assert 0.55 < share < 0.8


def test_the_share_of_relabelled_rows_is_her_ratio_at_every_position():
    torch.manual_seed(0)
    rb = make_buffer(500, her_ratio=0.8, seed=0, batch_size=50)
    rb.extend(Envs(4, [1, 7, 20]).chunk(125).reshape(-1))
    mask = torch.stack([relabelled(rb.sample()) for _ in range(300)])
    check_share(mask, 0.8)
    for position in mask.T:
        check_share(position, 0.8)


@pytest.mark.parametrize(
    ("strategy", "message"),
    [
        (lambda step, first, end, rng: end, "from first to end - 1"),
        (lambda step, first, end, rng: step.float(), "integer steps"),
        (lambda step, first, end, rng: step[:-1], "integer steps"),
        (lambda step, first, end, rng: step.numpy(), "a tensor of integer.*array"),
    ],
)
def test_a_users_strategy_with_wrong_steps_raises(strategy, message):
    rb = make_buffer(strategy=strategy)
    rb.extend(Envs(3, [6]).chunk(6).reshape(-1))
    with pytest.raises(ValueError, match=message):
        rb.sample()


@pytest.mark.parametrize(
    ("values", "got"),
    [(lambda achieved, desired: torch.zeros(8), r"\(8,\)"), (lambda *_: 0.0, "float")],
)
@pytest.mark.parametrize("name", ["reward_fn", "terminated_fn"])
def test_functions_that_return_no_column_raise(name, values, got):
    functions = {"reward_fn": reward_fn, "terminated_fn": terminated_fn, name: values}
    rb = buffer(
        HindsightRelabel(**functions, her_ratio=1.0), capacity=100, batch_size=8
    )
    with pytest.raises(ValueError, match=rf"{name}.*tensor.*\(.*, 1\), got {got}"):
        rb.extend(Envs(2, [4]).chunk(4).reshape(-1))
        rb.sample()


def test_relabelled_entries_keep_the_types_of_the_data():
    transform = HindsightRelabel(
        lambda achieved, desired: reward_fn(achieved, desired).double(),
        terminated_fn=lambda achieved, desired: terminated_fn(achieved, desired).int(),
    )
    rb = buffer(transform, capacity=100)
    data = Envs(2, [5]).chunk(5).reshape(-1)
    data["next", "achieved_goal"] = data["next", "achieved_goal"].double()
    rb.extend(data)
    batch = rb.sample()
    check_batch(batch, rb.storage[:], "future")
    assert batch["desired_goal"].dtype == torch.float32
    assert batch["next", "reward"].dtype == torch.float32
    assert batch["next", "terminated"].dtype == torch.bool


# -- which trajectory -----------------------------------------------------------------


def test_flat_data_without_ids_raise():
    rb = make_buffer()
    with pytest.raises(ValueError, match=r"trajectory_key=.*single_env=True"):
        rb.extend(Envs(2, [5]).chunk(5).exclude("collector").reshape(-1))


@pytest.mark.parametrize("key", ["desired_goal", "achieved_goal", "done"])
@pytest.mark.parametrize("later", [False, True])
def test_missing_entries_raise(key, later):
    rb, envs = make_buffer(), Envs(2, [5])
    if later:
        rb.extend(envs.chunk(5).reshape(-1))
    with pytest.raises(KeyError, match=rf"needs .*{key}"):
        rb.extend(envs.chunk(5).exclude(("next", key)).reshape(-1))


def test_an_empty_batch_changes_nothing():
    rb, envs = buffer(HindsightRelabel(reward_fn)), Envs(2, [5])
    rb.extend(envs.chunk(5).reshape(-1))
    stored = len(rb)
    rb.extend(envs.chunk(5).reshape(-1)[:0])
    assert len(rb) == stored
    rb.extend(envs.chunk(5).reshape(-1))
    check_batch(rb.sample(), rb.storage[:], "future")


@pytest.mark.parametrize("ids", [True, False])
def test_a_batch_size_that_lacks_the_time_raises(ids):
    data = Envs(3, [5]).chunk(5).exclude("collector")
    data.batch_size = [3]
    if ids:
        data["collector", "traj_ids"] = torch.arange(3)
    rb = make_buffer(single_env=not ids)
    with pytest.raises(
        ValueError, match=r"got \(3, 5, 1\) in data of batch size \[3\]"
    ):
        rb.extend(data)


def test_rows_stored_without_the_transform_raise(tmp_path):
    plain = buffer(None, capacity=100)
    plain.extend(Envs(2, [5]).chunk(5).reshape(-1))
    plain.dumps(tmp_path)
    loaded = make_buffer(100)
    loaded.loads(tmp_path)
    plain.append_transform(HindsightRelabel(reward_fn))
    for rb in (plain, loaded):
        with pytest.raises(RuntimeError, match="before the first"):
            rb.sample()
        with pytest.raises(RuntimeError, match="before the first"):
            rb.extend(Envs(2, [5]).chunk(5).reshape(-1))


def test_relabelling_keeps_trajectories_with_equal_ids_apart():
    """Collectors in turn, each of which leaves episodes unfinished, without roots."""
    rb = make_buffer(strategy="episode")
    for i in range(4):
        envs = Envs(3, [7], first_env=10 * i)
        for _ in range(5):
            rb.extend(envs.chunk(2).reshape(-1).exclude("achieved_goal"))
        rb.transform[0].end_trajectories()
    for _ in range(5):
        batch = rb.sample()
        check_batch(batch, rb.storage[:], "episode")
        assert relabelled(batch).any()


@pytest.mark.parametrize(
    ("layout", "steps"), [("env_first", 1), ("env_first", 2), ("no_ids", 2)]
)
def test_ids_alone_decide_if_root_goals_tell_nothing(layout, steps):
    """As in made-up data."""
    rb = make_buffer(
        ndim=2 if layout == "no_ids" else 1, strategy="final", her_ratio=1.0
    )
    envs = Envs(3, [7])
    for _ in range(14 // steps):
        data = envs.chunk(steps)
        data["achieved_goal"] = torch.randn(data["achieved_goal"].shape)
        rb.extend(flatten(data, layout))
    batch = rb.sample()
    assert (batch["desired_goal"][:, 2] == 7).all()  # the last step of the episode


def test_batches_may_come_with_or_without_root_goals():
    rb = make_buffer()
    for i, rooted in enumerate([True, False, True]):
        data = Envs(3, [7], first_env=10 * i).chunk(5).reshape(-1)
        rb.extend(data if rooted else data.exclude("achieved_goal").clone())
    check_batch(rb.sample(), rb.storage[:], "future")


@pytest.mark.parametrize("one_by_one", [True, False])
def test_single_env_needs_no_trajectory_ids(one_by_one):
    rb = make_buffer(30, single_env=True, her_ratio=1.0)
    envs = Envs(1, [1, 4, 9])
    for _ in range(30):
        data = envs.chunk(7)[0].exclude("collector")
        if one_by_one:
            for transition in data.unbind(0):
                rb.add(transition)
        else:
            rb.extend(data)
        check_batch(rb.sample(), rb.storage[:], "future", her_ratio=1.0)


def test_added_transitions_are_relabelled_by_their_ids():
    rb = make_buffer(30)
    envs = Envs(3, [1, 4, 9])
    for _ in range(40):
        for transition in envs.chunk(1).reshape(-1).unbind(0):
            rb.add(transition)
        check_batch(rb.sample(), rb.storage[:], "future")


def test_done_ends_a_trajectory_whose_id_stays():
    rb = make_buffer(trajectory_key="env", strategy="final")
    envs = Envs(3, [4, 2])
    for _ in range(5):
        data = envs.chunk(5).exclude("collector", "achieved_goal").reshape(-1)
        data["env"] = torch.arange(3).repeat_interleave(5)[:, None]
        rb.extend(data)
    check_batch(rb.sample(), rb.storage[:], "final")


def test_data_of_three_dimensions_are_relabelled():
    envs = Envs(6, [1, 5, 12])
    rb = make_buffer(120, ndim=3)
    for _ in range(40):
        rb.extend(envs.chunk(4).exclude("collector").unflatten(0, (2, 3)))
        batch = rb.sample()
        check_batch(batch, rb.storage[:].flatten(0, 1), "future")
    assert relabelled(batch).any()


# -- storages, samplers, buffers ------------------------------------------------------


def test_a_memmap_storage_is_relabelled_and_not_written_into(tmp_path):
    rb = buffer(
        HindsightRelabel(reward_fn),
        storage=LazyMemmapStorage(60, scratch_dir=tmp_path),
        cls=ReplayBuffer,
        batch_size=32,
    )
    envs = Envs(3, [5, 9])
    for _ in range(20):
        rb.extend(envs.chunk(4).reshape(-1))
        before = rb.storage[:].clone()
        check_batch(rb.sample(), before, "future")
        check_batch(rb[:], before, "future")
        assert (rb.storage[:] == before).all(), "the storage was written into"


def test_rows_read_by_index_are_relabelled():
    rb = make_buffer(60, ndim=2)
    rb.extend(Envs(3, [5, 9]).chunk(20))
    batch = rb[:]
    assert batch.shape == (3, 20)
    assert not is_mixed(batch).any()
    assert relabelled(batch).any()
    rb = make_buffer(her_ratio=1.0, strategy="final")
    rb.extend(Envs(3, [5]).chunk(5).reshape(-1))
    before = rb.storage[:].clone()
    row = rb[7]
    assert row.shape == ()
    assert row["next", "reward"].shape == (1,)
    assert row["desired_goal"].tolist() == [1, 0, 5]
    assert (rb.storage[:] == before).all(), "the storage was written into"


@pytest.mark.parametrize(("strategy", "strict"), [("future", True), ("final", False)])
def test_slices_share_a_goal(strategy, strict):
    sampler = SliceSampler(
        slice_len=4, traj_key=("collector", "traj_ids"), strict_length=strict
    )
    rb = make_buffer(
        200, sampler=sampler, unit="slice", strategy=strategy, seed=0, batch_size=64
    )
    envs = Envs(1, [4, 9, 16])
    share = []
    for _ in range(30):
        rb.extend(envs.chunk(16).reshape(-1))
        batch = rb.sample()
        check_batch(batch, rb.storage[:], strategy, her_ratio=None)
        ends = batch["next", "truncated"].squeeze(-1).nonzero().flatten().tolist()
        start = 0
        for end in ends:
            piece = batch[start : end + 1]
            assert (piece["desired_goal"] == piece["desired_goal"][0]).all()
            if relabelled(piece).any():
                last = piece["next", "achieved_goal"][-1, 2]
                assert (piece["desired_goal"][:, 2] >= last).all()
            share.append(relabelled(piece)[0].float())
            start = end + 1
    share = torch.stack(share)
    # Neighbouring slices that follow each other count as one, hence 6 errors, not 4.
    assert abs(share.mean() - 0.8) <= 6 * 0.4 / len(share) ** 0.5


def test_a_sampler_that_overwrites_relabelled_ends_is_refused():
    def sample(**options):
        sampler = SliceSampler(
            slice_len=4, traj_key=("collector", "traj_ids"), **options
        )
        rb = make_buffer(
            100, sampler=sampler, unit="slice", terminated_fn=terminated_fn
        )
        rb.extend(Envs(1, [8]).chunk(16).reshape(-1))
        return rb.sample()

    sample(truncated_key=None)
    with pytest.raises(ValueError, match="truncated_key=None"):
        sample()


def test_padded_slices_share_a_goal():
    sampler = SliceSampler(
        slice_len=6,
        traj_key=("collector", "traj_ids"),
        strict_length=False,
        pad_output=True,
    )
    rb = make_buffer(100, sampler=sampler, unit="slice", her_ratio=1.0, batch_size=60)
    envs = Envs(1, [2, 9])
    for _ in range(10):
        rb.extend(envs.chunk(20).reshape(-1))
        batch = rb.sample()
        assert relabelled(batch).all()
        pieces = batch["desired_goal"].view(10, 6, 3)
        assert (pieces == pieces[:, :1]).all()


def test_prefetched_goals_are_right_while_another_thread_writes():
    rb = buffer(HindsightRelabel(reward_fn), capacity=100, prefetch=3)
    envs = Envs(3, [5, 9, 30])
    failures, count = [], 0

    def write():
        try:
            for _ in range(100):
                rb.extend(envs.chunk(3).reshape(-1))
        except Exception as error:
            failures.append(error)

    rb.extend(envs.chunk(3).reshape(-1))
    writer = threading.Thread(target=write)
    writer.start()
    while writer.is_alive():
        batch = rb.sample()
        count += int(relabelled(batch).sum())
        assert not is_mixed(batch).any()
        goal, achieved = batch["desired_goal"], batch["next", "achieved_goal"]
        assert (goal[:, 2] >= achieved[:, 2])[relabelled(batch)].all()
    writer.join()
    assert not failures
    assert count
    rb.shutdown()


# -- saving, emptying, sharing --------------------------------------------------------


@pytest.mark.parametrize(
    ("how", "seed", "strategy"),
    [
        ("state_dict", None, "future"),
        ("state_dict", 3, "desired"),
        ("dumps", None, "desired"),
        ("dumps", 3, "random"),
    ],
)
def test_a_reloaded_buffer_draws_the_same_goals(how, seed, strategy, tmp_path):
    def extend(rb, envs, steps):
        rb.extend(name_goals(envs.chunk(steps)).reshape(-1))

    def sample(rb, envs):
        torch.manual_seed(5)
        batches = []
        for _ in range(5):
            batches.append(rb.sample())
            extend(rb, envs, 3)
        return torch.stack(batches)

    options = {"seed": seed, "strategy": strategy, "her_ratio": 1.0}
    rb, new = make_buffer(100, **options), make_buffer(100, **options)
    envs = Envs(3, [5, 9])
    for _ in range(30):
        extend(rb, envs, 4)
        rb.sample()
    if how == "dumps":
        rb.dumps(tmp_path)
        new.loads(tmp_path)
    else:
        state = {k: v for k, v in rb.state_dict().items()}
        extend(new, Envs(3, [5]), 1)  # a storage is made lazily
        new.load_state_dict(state)
    more = [Envs(3, [5, 9], seed=1, first_id=1000) for _ in range(2)]
    expected, got = sample(rb, more[0]), sample(new, more[1])
    assert (expected == got).all()
    batch = new.sample()
    goal, achieved = batch["desired_goal"], batch["next", "achieved_goal"]
    check_goals(goal, achieved, new.storage[:], strategy)


def test_an_empty_buffer_is_loaded():
    rb, new = make_buffer(), make_buffer(strategy="final", her_ratio=1.0)
    new.transform[0].set_extra_state(rb.transform[0].get_extra_state())
    new.extend(Envs(3, [5, 9]).chunk(20).reshape(-1))
    check_batch(new.sample(), new.storage[:], "final", her_ratio=1.0)


@pytest.mark.parametrize("how", ["state_dict", "dumps"])
@pytest.mark.parametrize("rooted", [True, False])
def test_a_new_collector_after_a_reload_joins_no_old_trajectory(how, rooted, tmp_path):
    def chunk(envs):
        data = envs.chunk(5).reshape(-1)
        return data if rooted else data.exclude("achieved_goal")

    rb, new = make_buffer(), make_buffer()
    rb.extend(chunk(Envs(3, [7])))
    if how == "dumps":
        rb.dumps(tmp_path)
        new.loads(tmp_path)
    else:
        new.extend(chunk(Envs(3, [7])))  # a storage is made lazily
        new.load_state_dict(rb.state_dict())
    new.extend(chunk(Envs(3, [7], first_env=10)))
    check_batch(new.sample(), new.storage[:], "future")


def test_an_earlier_checkpoint_is_loaded_into_the_same_buffer(tmp_path):
    rb, envs = make_buffer(), Envs(3, [5, 9])
    rb.extend(envs.chunk(10).reshape(-1))
    rb.dumps(tmp_path)
    for steps in (10, 20):
        rb.extend(envs.chunk(steps).reshape(-1))
        rb.loads(tmp_path)
        check_batch(rb.sample(), rb.storage[:], "future")
    assert relabelled(rb.sample()).any()


@pytest.mark.parametrize("forgets", [False, True])
def test_an_emptied_buffer_forgets_its_old_goals(forgets):
    rb, envs = make_buffer(100, strategy="random"), Envs(3, [5, 9, 40])
    for _ in range(33):
        rb.extend(envs.chunk(4).reshape(-1))
        rb.sample()
    if forgets:
        rb.transform[0].empty()
    rb.empty()
    for _ in range(30):
        rb.extend(envs.chunk(4).reshape(-1))
        check_batch(rb.sample(), rb.storage[:], "random")


def test_the_memory_takes_few_bytes_per_transition():
    capacity = 20_000
    rb, envs = make_buffer(capacity), Envs(50, [50])
    for _ in range(100):
        rb.extend(envs.chunk(8).reshape(-1))
        rb.sample()
    state = rb.transform[0].get_extra_state()["memory"]
    arrays = sum(ring.nbytes for ring in state["rings"])
    serials = rb.storage[:]["hindsight_serial"].nbytes
    assert (arrays + serials) / capacity <= 2 * 3 * 4 + 16  # two goals of 3 numbers


def test_seed_does_not_touch_torchs_generator():
    def goals(rb):
        torch.manual_seed(0)
        index = rb.sample()["index"]
        return index, torch.rand(3)

    plain = buffer(None, capacity=100)
    rb = make_buffer(100, seed=0)
    data = Envs(3, [5]).chunk(10).reshape(-1)
    plain.extend(data)
    rb.extend(data)
    for a, b in zip(goals(plain), goals(rb), strict=True):
        assert (a == b).all()


# -- what it cannot be combined with --------------------------------------------------


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("late", [False, True])
def test_a_multi_step_transform_raises(nested, late):
    relabel = HindsightRelabel(reward_fn)
    multi_step = MultiStepTransform(n_steps=3, gamma=0.9)
    if nested:
        relabel = Compose(relabel)
        multi_step = Compose(DoubleToFloat(), Compose(multi_step))
    rb = buffer(
        Compose(relabel) if late else Compose(relabel, multi_step),
        capacity=100,
        ndim=2,
        batch_size=8,
    )
    envs = Envs(3, [5])
    if late:
        rb.extend(envs.chunk(5))
        rb.append_transform(multi_step)
    with pytest.raises(RuntimeError, match="MultiStepTransform"):
        rb.extend(envs.chunk(20))


@pytest.mark.parametrize("second", [HindsightRelabel, GoalSampler])
def test_a_second_hindsight_transform_raises(second):
    options = {"strategies": {"goal": "future"}} if second is GoalSampler else {}
    chain = Compose(HindsightRelabel(reward_fn), second(reward_fn=reward_fn, **options))
    rb = buffer(chain, capacity=100, batch_size=8)
    with pytest.raises(RuntimeError, match=f"one .*Relabel, {second.__name__}"):
        rb.extend(Envs(3, [5]).chunk(5).reshape(-1))


@pytest.mark.parametrize("nested", [False, True])
def test_hindsight_in_an_environment_raises(nested):
    transform = HindsightRelabel(reward_fn)
    with pytest.raises(ValueError, match="replay buffers"):
        TransformedEnv(
            GymEnv("Pendulum-v1"), Compose(transform) if nested else transform
        )
    env = TransformedEnv(GymEnv("Pendulum-v1"))
    with pytest.raises(ValueError, match="replay buffers"):
        env.append_transform(HindsightRelabel(reward_fn))


@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize("layout", ["env_first", "no_ids"])
def test_relabelling_ignores_the_default_device(seed, layout):
    """torchrl's buffers themselves do without one."""
    transform = HindsightRelabel(reward_fn, seed=seed, strategy="episode")
    data = Envs(3, [5]).chunk(10)
    data = flatten(data, layout)
    with torch.device("meta"):
        batch = transform(transform.inv(data))
    assert relabelled(batch).any()
    assert not is_mixed(batch).any()


@pytest.mark.parametrize("data_device", DEVICES)
@pytest.mark.parametrize("storage_device", DEVICES)
def test_goals_are_relabelled_on_the_device_of_the_storage(data_device, storage_device):
    rb = buffer(
        HindsightRelabel(reward_fn),
        storage=LazyTensorStorage(100, device=storage_device),
    )
    envs = Envs(3, [5, 9])
    for _ in range(30):
        rb.extend(envs.chunk(4).reshape(-1).to(data_device))
        batch = rb.sample()
        assert batch["desired_goal"].device.type == storage_device
        check_batch(batch.cpu(), rb.storage[:].cpu(), "future")
    assert isinstance(batch, TensorDict)


def test_goals_under_nested_keys_are_relabelled():
    transform = HindsightRelabel(
        reward_fn,
        her_ratio=1.0,
        goal_key=("goals", "desired"),
        achieved_goal_key=("goals", "achieved"),
    )
    rb = buffer(transform, capacity=30, batch_size=30)
    data = Envs(3, [5]).chunk(10).reshape(-1)
    for part in (data, data["next"]):
        part["goals"] = TensorDict(
            achieved=part.pop("achieved_goal"),
            desired=part.pop("desired_goal"),
            batch_size=[30],
        )
    rb.extend(data)
    before = rb.storage[:].clone()
    for batch in (rb.sample(), rb[:]):
        goal, achieved = batch["goals", "desired"], batch["next", "goals", "achieved"]
        assert (goal[:, :2] == achieved[:, :2]).all()
        assert (batch["next", "goals", "desired"] == goal).all()
        assert (batch["next", "reward"] == reward_fn(achieved, goal)).all()
    assert (rb.storage[:] == before).all()
