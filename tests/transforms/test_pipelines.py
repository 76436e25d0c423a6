"""Pipelines as people build them: hindsight is right in them, or says why not."""

import copy
import warnings
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import (
    ReplayBuffer,
    ReplayBufferEnsemble,
    SliceSampler,
    TensorDictMaxValueWriter,
    TensorStorage,
)
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    ExcludeTransform,
    ParallelEnv,
    SelectTransform,
    SerialEnv,
    TrajCounter,
    Transform,
    TransformedEnv,
)

import torch_panda
from tests.transforms import toy
from tests.transforms.identifiable import (
    Envs,
    check_batch,
    check_counts,
    check_share,
    name_goals,
    relabelled,
    reward_fn,
)
from tests.transforms.pipelines import buffer, collect, make
from torch_panda.transforms import HindsightRelabel

# -- from_env -------------------------------------------------------------------------


def success_worker():
    return make("PandaReach-v3", 2)


@pytest.mark.parametrize("nested", ["none", "transformed", "serial", "parallel"])
def test_from_env_takes_reward_success_and_ends_of_the_environment(nested):
    env = {
        "none": lambda: make("PandaReach-v3"),
        "transformed": lambda: TransformedEnv(
            TransformedEnv(make("PandaReach-v3"), DoubleToFloat()), Compose()
        ),
        "serial": lambda: TransformedEnv(SerialEnv(2, success_worker)),
        "parallel": lambda: ParallelEnv(2, success_worker),
    }[nested]()
    rb = buffer(HindsightRelabel.from_env(env, strategy="final", her_ratio=1.0))
    rules = torch_panda.make("PandaReach-v3")
    for data in collect(env, steps=20):
        rb.extend(data.reshape(-1))
        batch = rb.sample()
        after = batch["next"]
        goals = after["achieved_goal"], batch["desired_goal"]
        success = rules.is_success(*goals)
        assert (after["reward"] == rules.compute_reward(*goals)).all()
        assert (after["success"] == success).all()
        assert (after["terminated"] == success).all()
        assert (after["done"] == (success | after["truncated"])).all()
        assert success.any() and not success.all()
    env.close(raise_if_closed=False)


def test_from_env_leaves_ends_alone_where_success_ends_nothing():
    env = make("PandaReach-v1")
    rb = buffer(HindsightRelabel.from_env(env, strategy="final", her_ratio=1.0))
    for data in collect(env):
        rb.extend(data.reshape(-1))
    batch = rb.sample()
    assert batch["next", "success"].any()
    assert not batch["next", "terminated"].any()


def test_from_env_of_another_environment_raises():
    with pytest.raises(ValueError, match="no compute_reward: give reward_fn="):
        HindsightRelabel.from_env(toy.make_env())
    options = {"reward_fn": reward_fn, "success_fn": None}
    with pytest.raises(ValueError, match="terminate_on_success: give terminated_fn="):
        HindsightRelabel.from_env(toy.make_env(), **options)
    HindsightRelabel.from_env(toy.make_env(), **options, terminated_fn=None)


@pytest.mark.parametrize("with_success", [True, False])
def test_an_end_for_another_reason_stays(with_success):
    def reached(achieved, desired):
        return (achieved == desired).all(-1, keepdim=True)

    data = Envs(3, [4]).chunk(8).reshape(-1)
    data["next", "terminated"] = data["next", "done"].clone()  # failures
    data["next", "success"] = torch.zeros_like(data["next", "done"])
    functions = {"success_fn": reached} if with_success else {}
    transform = HindsightRelabel(
        reward_fn, terminated_fn=reached, strategy="random", **functions
    )
    rb = buffer(transform)
    rb.extend(data)
    batch, stored = rb.sample(2000), rb.storage[:]
    success = reached(batch["next", "achieved_goal"], batch["desired_goal"])
    failed = stored["next", "terminated"][batch["index"]]
    assert (batch["next", "terminated"] == (success | failed)).all()
    if with_success:
        assert (batch["next", "success"] == success).all()
    assert failed.any() and (success & ~failed).any()


# -- buffers --------------------------------------------------------------------------


def slices():
    return SliceSampler(slice_len=4, traj_key=("collector", "traj_ids"))


@pytest.mark.parametrize("strategy", ["future", "episode", "random"])
def test_an_ensemble_of_buffers_is_relabelled(strategy):
    transforms = [
        HindsightRelabel(reward_fn, strategy=strategy, her_ratio=1.0) for _ in "ab"
    ]
    members = [buffer(transform) for transform in transforms]
    for number, member in enumerate(members):
        member.extend(Envs(4, [10]).chunk(40 + number).reshape(-1))
    both = ReplayBufferEnsemble(*members, batch_size=64)
    for _ in range(3):
        for batch, member in zip(both.sample().unbind(0), members, strict=True):
            own = member.storage[:]["desired_goal"]
            is_old = (batch["desired_goal"][:, None] == own).all(-1).any(1)
            assert is_old.float().mean() < 0.1


def test_rows_of_another_transform_in_an_ensemble_are_refused():
    mine, other = (HindsightRelabel(reward_fn) for _ in "ab")
    members = [buffer(None), buffer(None)]
    members[0].extend(mine.prepare(Envs(4, [10]).chunk(20)))
    members[1].extend(other.prepare(Envs(4, [10], first_env=4).chunk(20)))
    both = ReplayBufferEnsemble(*members, batch_size=64, transform=mine)
    with pytest.raises(RuntimeError, match="not the transitions that this transform"):
        for _ in range(20):  # each sample draws from which buffers its rows come
            both.sample()


@pytest.mark.parametrize("unit", ["row", "slice"])
def test_slices_with_goals_per_row_warn_once(unit):
    rb = buffer(HindsightRelabel(reward_fn, unit=unit), sampler=slices())
    rb.extend(Envs(1, [16]).chunk(64).reshape(-1))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rb.sample()
        rb.sample()
    messages = [str(w.message) for w in caught if "unit=" in str(w.message)]
    assert len(messages) == (unit == "row")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"\[2, 8\] for ndim=1.*reshape.*ndim=2"),
        ({"ndim": 2, "dim_extend": 0}, "dim_extend=0 for ndim=2"),
        ({"ndim": 3}, r"\[2, 8\] for ndim=3.*reshape.*ndim=1"),
    ],
)
def test_layouts_that_do_not_fit_are_refused_at_once(options, message):
    rb, data = buffer(HindsightRelabel(reward_fn), **options), Envs(2, [4]).chunk(8)
    with pytest.raises(RuntimeError, match=message):
        rb.extend(data)


def count_trajectories(first_env):
    env = toy.ToyEnv(3, first_env)
    return TransformedEnv(env, TrajCounter())


def test_ids_that_environments_share_are_refused():
    workers = [partial(count_trajectories, first_env) for first_env in (1, 2)]
    data = SerialEnv(2, workers).rollout(20, break_when_any_done=False)
    data["next", "reward"] = reward_fn(
        data["next", "achieved_goal"], data["desired_goal"]
    )
    rb = buffer(HindsightRelabel(reward_fn, trajectory_key="traj_count"), ndim=3)
    with pytest.raises(ValueError, match=r"id 0 at 'traj_count'.*make .* unique"):
        rb.extend(data)
    data["traj_count"][1] += 1000
    rb.extend(data)


class KeepEveryThird(Transform):
    def _inv_call(self, tensordict):
        return tensordict[::3]


def test_dropping_rows_before_hindsight_is_refused():
    rb = buffer(Compose(KeepEveryThird(), HindsightRelabel(reward_fn)))
    envs = Envs(2, [4])
    rb.extend(envs.chunk(9).reshape(-1))
    with pytest.raises(RuntimeError, match=r"18 rows.*only 6: .*drop rows after it"):
        rb.extend(envs.chunk(9).reshape(-1))
    rb = buffer(Compose(HindsightRelabel(reward_fn), KeepEveryThird()))
    for _ in range(20):
        rb.extend(envs.chunk(9).reshape(-1))
    check_batch(rb.sample(), rb.storage[:], "future")


def test_a_buffer_that_consumes_rows_is_refused():
    rb = buffer(HindsightRelabel(reward_fn), consume_after_n_samples=1, batch_size=8)
    envs = Envs(2, [4])
    rb.extend(envs.chunk(9).reshape(-1))
    rb.sample()
    rb.extend(envs.chunk(9).reshape(-1))
    with pytest.raises(RuntimeError, match=r"18 rows.*only 10: .*consume_after_n"):
        rb.extend(envs.chunk(9).reshape(-1))


def test_data_with_time_first_are_refused():
    steps = Envs(3, [4]).chunk(8).exclude("collector").unbind(1)
    rb = buffer(HindsightRelabel(reward_fn), ndim=2)
    with pytest.raises(ValueError, match=r"\[8, 3\].*must be \[num_envs, time\]"):
        rb.extend(torch.stack(steps))
    rb.extend(torch.stack(steps, dim=1))


def test_replacing_rows_is_refused():
    rb, data = buffer(HindsightRelabel(reward_fn)), Envs(2, [4]).chunk(8).reshape(-1)
    rb.extend(data)
    with pytest.raises(RuntimeError, match=r"replacing.*use extend"):
        rb[2:4] = data[:2]


def test_adding_several_steps_as_one_is_refused():
    rb = buffer(HindsightRelabel(reward_fn))
    message = r"add\(\).*\[16\].*call extend\(\).*extend_buffer"
    with pytest.raises(RuntimeError, match=message):
        rb.add(Envs(2, [4]).chunk(8).reshape(-1))


def test_a_transform_that_moves_to_another_buffer_goes_by_that_one():
    chain = Compose(HindsightRelabel(reward_fn, strategy="episode"))
    first = buffer(chain)
    first.extend(Envs(2, [4]).chunk(8).reshape(-1))
    second = buffer(chain, ndim=2)
    envs = Envs(3, [5], first_env=10)
    chain[0].empty()
    for _ in range(200):  # the second is written over
        second.extend(envs.chunk(2))
    check_batch(second.sample(), second.storage[:].reshape(-1), "episode")
    with pytest.raises(RuntimeError, match="ndim=1"):
        first.extend(envs.chunk(2))
    writer = TensorDictMaxValueWriter(rank_key=("next", "reward"))
    third = buffer(chain, writer=writer)
    with pytest.raises(RuntimeError, match="round-robin"):
        third.extend(envs.chunk(2).reshape(-1))


@pytest.mark.parametrize("share", ["object", "clone"])
def test_a_second_buffer_is_refused(share):
    transform = HindsightRelabel(reward_fn)
    first = buffer(transform)
    envs = Envs(2, [4])
    first.extend(envs.chunk(8).reshape(-1))
    second = buffer(Compose(transform if share == "object" else transform.clone()))
    with pytest.raises(RuntimeError, match="belongs to another replay buffer"):
        second.extend(envs.chunk(8).reshape(-1))
    first.extend(envs.chunk(8).reshape(-1))
    check_batch(first.sample(), first.storage[:], "future")
    assert relabelled(first.sample()).float().mean() > 0.6


def test_a_copied_buffer_goes_on_by_itself():
    first, envs = buffer(HindsightRelabel(reward_fn)), Envs(2, [4, 9])
    first.extend(envs.chunk(10).reshape(-1))
    second, others = copy.deepcopy(first), copy.deepcopy(envs)
    for rb, source in ((first, envs), (second, others)):
        rb.extend(source.chunk(10).reshape(-1))
        check_batch(rb.sample(), rb.storage[:], "future")


SELECTED = ["desired_goal", "achieved_goal", "next", "collector"]


@pytest.mark.parametrize(
    "before",
    [
        lambda: SelectTransform(*SELECTED),
        lambda: ExcludeTransform("hindsight_serial"),
        lambda: Compose(DoubleToFloat(), Compose(SelectTransform(*SELECTED))),
    ],
)
def test_selecting_before_hindsight_is_named(before):
    rb = buffer(Compose(before(), HindsightRelabel(reward_fn)))
    rb.extend(Envs(2, [4]).chunk(8).reshape(-1))
    with pytest.raises(RuntimeError, match="select or exclude entries after it"):
        rb.sample()


def test_excluding_a_needed_entry_before_hindsight_is_named():
    before = ExcludeTransform(("next", "achieved_goal"))
    rb = buffer(Compose(before, HindsightRelabel(reward_fn)))
    rb.extend(Envs(2, [4]).chunk(8).reshape(-1))
    with pytest.raises(KeyError, match=r"needs .*achieved_goal"):
        rb.sample()


def test_selecting_after_hindsight_works():
    after = SelectTransform("desired_goal", "next")
    rb = buffer(Compose(HindsightRelabel(reward_fn, her_ratio=1.0), after))
    rb.extend(Envs(2, [4]).chunk(8).reshape(-1))
    batch = rb.sample()
    assert relabelled(batch).all() and "action" not in batch


def test_the_representation_names_the_options():
    relabel = HindsightRelabel(reward_fn, strategy={"future": 1}, goal_parts=(3, 3))
    assert repr(relabel) == (
        "HindsightRelabel(strategy={'future': 1}, her_ratio=0.8, unit='row', "
        "goal_parts=(3, 3))"
    )


# -- collectors that extend the buffer themselves -------------------------------------


def test_a_collector_may_write_into_a_two_dimensional_buffer():
    rb = buffer(HindsightRelabel(reward_fn), ndim=2)
    collector = Collector(
        toy.make_env,
        None,
        frames_per_batch=3 * 5,
        total_frames=3 * 5 * 100,
        replay_buffer=rb,
    )
    for _ in collector:
        batch = rb.sample()
        check_batch(batch, rb.storage[:].reshape(-1), "future")
        assert relabelled(batch).any()
    collector.shutdown()
    assert rb.write_count > len(rb.storage) // 3  # it was written over


def test_a_collector_that_writes_into_a_flat_buffer_is_refused():
    rb = buffer(HindsightRelabel(reward_fn))
    collector = Collector(
        toy.make_env, None, frames_per_batch=15, total_frames=30, replay_buffer=rb
    )
    with pytest.raises(RuntimeError, match=r"ndim=2.*replay_buffer="):
        next(iter(collector))
    collector.shutdown()


@pytest.mark.parametrize("ndim", [1, 2])
def test_a_multi_process_collector_with_the_buffer_is_refused(ndim):
    # A TensorDictReplayBuffer of ndim=2 fails at the first [num_envs, 1] by itself.
    rb = buffer(HindsightRelabel(reward_fn), ndim=ndim, cls=ReplayBuffer)
    message = "multi-process collector" if ndim == 2 else "replay_buffer="
    with pytest.raises(RuntimeError, match=message):
        MultiSyncCollector(
            [toy.make_first, toy.make_second],
            None,
            frames_per_batch=30,
            total_frames=60,
            replay_buffer=rb,
        )


# -- strategies and parts -------------------------------------------------------------


def goals_data(num_envs=4):
    return name_goals(Envs(num_envs, [5, 8]).chunk(40)).reshape(-1)


def sample_goals(strategy):
    """Returns the goals of 20,000 relabelled rows, their own goals, and the storage."""
    torch.manual_seed(0)
    transform = HindsightRelabel(reward_fn, strategy=strategy, her_ratio=1.0, seed=0)
    rb = buffer(transform, capacity=500)
    for data in goals_data(num_envs=16).split(160):  # 640 rows, 140 are overwritten
        rb.extend(data)
    batch, stored = rb.sample(20_000), rb.storage[:]
    return batch["desired_goal"], stored["desired_goal"][batch["index"]], stored


def test_desired_goals_are_drawn_uniformly_from_stored_transitions():
    drawn, own, stored = sample_goals("desired")
    goals, rows = stored["desired_goal"].unique(dim=0, return_counts=True)
    drawn_goals, counts = drawn.unique(dim=0, return_counts=True)
    assert torch.equal(drawn_goals, goals)
    shares = rows / len(stored)
    check_counts(counts, shares * len(drawn))
    # A row gets its own goal back by chance only.
    check_share((drawn == own).all(1), float(shares.square().sum()))


def test_random_goals_are_drawn_uniformly_from_stored_transitions():
    drawn, _, stored = sample_goals("random")
    goals = stored["next", "achieved_goal"].unique(dim=0)
    drawn_goals, counts = drawn.unique(dim=0, return_counts=True)
    assert torch.equal(drawn_goals, goals)
    check_counts(counts, torch.full((len(goals),), len(drawn) / len(goals)))


@pytest.mark.parametrize("parts", [(3, 3), (2,)])
def test_parts_that_do_not_add_up_raise(parts):
    rb = buffer(HindsightRelabel(reward_fn, goal_parts=parts))
    with pytest.raises(ValueError, match="goal_parts must add up to"):
        rb.extend(goals_data())


# -- data that exist already ----------------------------------------------------------


def fill_without_hindsight():
    """The storage of a buffer that was written over."""
    filled, envs = buffer(None, capacity=70), Envs(4, [5, 9])
    for _ in range(9):
        filled.extend(envs.chunk(3).reshape(-1))
    return filled.storage[:]


EXISTING = {
    "ids": lambda: Envs(4, [5, 9]).chunk(30).reshape(-1),
    "trajectories": lambda: Envs(20, [9]).chunk(9).exclude("collector"),
    "storage": fill_without_hindsight,
}


def test_shuffled_data_are_refused():
    data = Envs(4, [9]).chunk(90).reshape(-1)[torch.randperm(360)]
    with pytest.raises(ValueError, match="in the order of time, not shuffled"):
        HindsightRelabel(reward_fn).prepare(data)


@pytest.mark.parametrize("storage", ["memory", "memmap"])
@pytest.mark.parametrize("layout", EXISTING)
def test_existing_data_are_relabelled_and_not_changed(storage, layout, tmp_path):
    data = EXISTING[layout]()
    if storage == "memmap":
        data.memmap(tmp_path)
        data = TensorDict.load_memmap(tmp_path)
        for file in tmp_path.rglob("*.memmap"):
            file.chmod(0o444)
    before = data.clone()
    relabel = HindsightRelabel(reward_fn, her_ratio=0.8)
    prepared = relabel.prepare(data)
    assert prepared.shape == (data.numel(),)
    if storage == "memmap":
        assert prepared["action"].data_ptr() == data["action"].data_ptr()
    rb = buffer(relabel, storage=TensorStorage(prepared), batch_size=256)
    check_batch(rb.sample(), prepared, "future")
    assert (data == before).all()
    with pytest.raises(RuntimeError, match="before any extend"):
        relabel.prepare(data)
