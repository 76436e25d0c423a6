"""Data in which relabelled transitions would contradict themselves are refused."""

import functools
import warnings

import pytest
import torch
from torchrl.collectors.utils import split_trajectories
from torchrl.data import MultiStep, TensorStorage, Unbounded
from torchrl.envs import (
    CatTensors,
    Compose,
    FrameSkipTransform,
    ObservationNorm,
    ParallelEnv,
    RewardScaling,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)

import torch_panda
from tests.transforms.identifiable import (
    Envs,
    check_batch,
    name_goals,
    reward_fn,
)
from tests.transforms.pipelines import buffer, collect, make
from torch_panda import Randomization, datasets
from torch_panda.transforms import HindsightRelabel
from torch_panda.transforms.checks import MIN_CHECKS

STALE = r"{}.*after this transform"


def store(env, transform, steps=6, batches=3, **options):
    """Stores batches of a collector, and samples often enough for all checks."""
    rb = buffer(transform)
    for data in collect(env, steps, batches, **options):
        rb.extend(data.reshape(-1))
        rb.sample()
    sample(rb)


def sample(rb):
    for _ in range(MIN_CHECKS):
        rb.sample()


def get_warnings(function):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        function()
    return [str(warning.message) for warning in caught]


# -- copies of the goal ---------------------------------------------------------------


def cat(*keys):
    return CatTensors(list(keys), "policy_input", del_keys=False)


def cat_goal():
    return cat("observation", "desired_goal")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
@pytest.mark.parametrize("shape", [(40, 7), (40, 1, 7)])
def test_copies_that_are_less_precise_are_refused(dtype, shape):
    data = Envs(4, [5]).chunk(10).reshape(-1)
    for key in ("desired_goal", "achieved_goal", ("next", "achieved_goal")):
        data[key] = data[key].double() + torch.rand(40, 3, dtype=torch.float64)
    data["next", "desired_goal"] = data["desired_goal"].clone()
    copy = torch.cat([torch.rand(40, 4), data["desired_goal"]], 1)
    data["policy_input"] = copy.to(dtype).reshape(shape)
    goals = data["next", "achieved_goal"], data["desired_goal"]
    data["next", "reward"] = reward_fn(*goals).float()
    rb = buffer(HindsightRelabel(reward_fn))
    rb.extend(data)
    with pytest.raises(ValueError, match=r"policy_input.*copy"):
        rb.sample()


def test_copies_made_in_the_buffer_before_hindsight_are_refused():
    env = make()
    rb = buffer(Compose(cat_goal(), HindsightRelabel.from_env(env)))
    rb.extend(next(iter(collect(env))).reshape(-1))
    with pytest.raises(ValueError, match=r"policy_input.*copy.*after this transform"):
        rb.sample()


def test_concatenating_after_hindsight_has_the_new_goal():
    env = make()
    rb = buffer(Compose(HindsightRelabel.from_env(env, her_ratio=1.0), cat_goal()))
    rb.extend(next(iter(collect(env))).reshape(-1))
    batch = rb.sample()
    achieved = rb.storage[:]["next", "achieved_goal"]
    assert (batch["desired_goal"][:, None] == achieved).all(-1).any(1).all()
    pieces = batch["policy_input"].unfold(1, 3, 1)
    assert (pieces == batch["desired_goal"][:, None]).all(-1).any(1).all()


@pytest.mark.parametrize("goals", ["achieved", "zeros"])
def test_observations_that_hold_the_achieved_goal_are_no_copies(goals):
    """This holds even if each desired goal is the achieved one, or is constant."""
    data = Envs(4, [5]).chunk(10).reshape(-1)
    goal = data["achieved_goal"] if goals == "achieved" else torch.zeros(40, 3)
    data["desired_goal"], data["next", "desired_goal"] = goal.clone(), goal.clone()
    data["observation"] = torch.cat([torch.zeros(40, 4), data["achieved_goal"]], 1)
    data["next", "reward"] = reward_fn(data["next", "achieved_goal"], goal)
    rb = buffer(HindsightRelabel(reward_fn))
    rb.extend(data)
    rb.sample()


# -- entries computed from the goal ---------------------------------------------------


class GoalDifference(Transform):
    """Adds `difference`, the desired minus the achieved goal."""

    def __init__(self):
        keys = ["desired_goal", "achieved_goal"]
        super().__init__(in_keys=keys, out_keys=["difference"])

    def _call(self, tensordict):
        difference = tensordict["desired_goal"] - tensordict["achieved_goal"]
        return tensordict.set("difference", difference)

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)

    def transform_observation_spec(self, spec):
        spec["difference"] = Unbounded(spec["desired_goal"].shape)
        return spec


def normalise(key, out):
    return ObservationNorm(0.3, 2.0, in_keys=[key], out_keys=[out])


COMPUTED = {
    "difference": GoalDifference,
    "policy_input": lambda: Compose(
        normalise("desired_goal", "normalised"),
        CatTensors(["observation", "normalised"], "policy_input"),
    ),
    "observation": lambda: Compose(
        normalise("desired_goal", "normalised"),
        CatTensors(["observation", "normalised"], "observation"),
    ),
}


def make_short(env_id="PandaPush-v1", num_envs=4, **options):
    return torch_panda.make(
        env_id, num_envs=num_envs, seed=0, max_episode_steps=6, **options
    )


@pytest.mark.parametrize("key", COMPUTED)
@pytest.mark.parametrize(
    ("env_id", "bare"), [("PandaPush-v1", True), ("PandaPegInsertion-v1", False)]
)
def test_entries_computed_from_the_goal_are_refused(key, env_id, bare):
    env = TransformedEnv(make_short(env_id), COMPUTED[key]())
    transform = HindsightRelabel.from_env(make_short(env_id) if bare else env)
    with pytest.raises(ValueError, match=STALE.format(key)):
        store(env, transform)


def test_goals_are_gathered_over_batches():
    """One environment has one goal per batch."""
    env = TransformedEnv(make_short(num_envs=1), COMPUTED["difference"]())
    with pytest.raises(ValueError, match=STALE.format("difference")):
        store(env, HindsightRelabel.from_env(env), steps=1, batches=60)


def test_too_few_goals_pass():
    """An affine function of goals fits any constant of so few episodes."""
    env = TransformedEnv(make_short(), COMPUTED["difference"]())
    store(env, HindsightRelabel.from_env(env), batches=1)


@pytest.mark.parametrize("key", COMPUTED)
def test_without_an_environment_a_computed_entry_is_a_warning(key):
    env = TransformedEnv(make_short(), COMPUTED[key]())
    transform = HindsightRelabel(env.base_env.compute_reward)
    messages = get_warnings(lambda: store(env, transform))
    matches = [message for message in messages if "affine" in message]
    assert len(matches) == 1
    assert key in matches[0] and "after this transform" in matches[0]


def randomized(env_id):
    randomization = Randomization(object_mass=(0.5, 2), gravity=(0.9, 1), observe=True)
    return make_short(env_id, randomize=randomization)


PASSING = {
    "physics parameters": lambda: randomized("PandaPush-v1"),
    "constants in the observation": lambda: make_short("PandaPegInsertion-v1"),
    "concatenated constants": lambda: TransformedEnv(
        randomized("PandaPegInsertion-v1"),
        Compose(
            StepCounter(),
            normalise("observation", "normalised"),
            cat("physics_parameters", "normalised", "achieved_goal"),
        ),
    ),
    "computed from the achieved goal": lambda: TransformedEnv(
        make_short("PandaReach-v1"), normalise("achieved_goal", "normalised")
    ),
    "dense rewards": lambda: make_short("PandaStackDense-v1"),
}


@pytest.mark.parametrize("case", PASSING)
def test_entries_that_are_not_computed_from_the_goal_pass(case):
    env = PASSING[case]()
    transform = HindsightRelabel.from_env(env)
    messages = get_warnings(lambda: store(env, transform, batches=8))
    assert not [message for message in messages if "goal" in message]


# -- goals that the environment normalises --------------------------------------------


def norm(*keys):
    return ObservationNorm(0.0, 5.0, in_keys=[*keys])


NORMALISED = {
    "both": lambda: norm("achieved_goal", "desired_goal"),
    "achieved": lambda: Compose(norm("achieved_goal")),
    "VecNorm": lambda: VecNorm(["desired_goal"]),
    "VecNormV2": lambda: VecNormV2(["desired_goal"]),
}


def make_normalised():
    return TransformedEnv(make("PandaReach-v1", 2), norm("desired_goal"))


@pytest.mark.parametrize("case", [*NORMALISED, "worker", "outside"])
def test_from_env_refuses_normalised_goals(case):
    if case == "worker":
        env = ParallelEnv(2, make_normalised)
    elif case == "outside":
        worker = functools.partial(make, "PandaReach-v1", 2)
        env = TransformedEnv(SerialEnv(2, worker), norm("desired_goal"))
    else:
        env = TransformedEnv(make("PandaReach-v1"), NORMALISED[case]())
    with pytest.raises(ValueError, match=r"normalises '.*goal'.*after this transform"):
        HindsightRelabel.from_env(env)


def test_normalised_observations_are_accepted():
    HindsightRelabel.from_env(TransformedEnv(make(), norm("observation")))


def test_the_warning_shows_a_row_that_differs():
    data = name_goals(Envs(4, [5]).chunk(10)).reshape(-1)
    data["next", "reward"].zero_()  # although no goal is achieved
    rb = buffer(HindsightRelabel(reward_fn))
    with pytest.warns(UserWarning, match="-1 instead of 0 for") as caught:
        rb.extend(data)
        sample(rb)
    assert len([w for w in caught if "other rewards" in str(w.message)]) == 1


# -- rewards --------------------------------------------------------------------------


def test_rewards_of_several_steps_are_refused():
    def store_steps(n_steps):
        env = make_short("PandaReach-v1")
        postproc = MultiStep(gamma=0.9, n_steps=n_steps)
        store(env, HindsightRelabel.from_env(env), 12, 1, postproc=postproc)

    store_steps(1)
    with pytest.raises(ValueError, match=r"several steps.*MultiStep.*slice"):
        store_steps(3)


@pytest.mark.parametrize(
    ("env_id", "scaling"),
    [
        ("PandaPush-v1", (0.0, 10.0)),
        ("PandaReach-v1", (0.0, 0.1)),
        ("PandaPushDense-v1", (1.0, 2.0)),
        ("PandaReach-v1", (1.0, 1.0)),
    ],
)
def test_scaled_rewards_are_refused(env_id, scaling):
    """Also if only the successes show it, which are few in Reach."""
    env = TransformedEnv(make(env_id, 8), RewardScaling(*scaling))
    with pytest.raises(ValueError, match=r"\* reward_fn.*RewardScaling.*after"):
        store(env, HindsightRelabel.from_env(env), 50, 30)


def test_the_data_of_another_buffer_are_checked_too():
    env = make("PandaPush-v1", 8)
    relabel = HindsightRelabel.from_env(env)
    store(env, relabel)
    relabel.empty()
    with pytest.raises(ValueError, match=r"\* reward_fn.*RewardScaling"):
        store(TransformedEnv(make("PandaPush-v1", 8), RewardScaling(0.0, 0.1)), relabel)


def test_rewards_that_frame_skipping_added_up_are_refused():
    torch.manual_seed(1)  # of the random actions
    env = TransformedEnv(make("PandaPush-v1", 8), FrameSkipTransform(4))
    with pytest.raises(ValueError, match=r"4 \* reward_fn.*FrameSkipTransform"):
        store(env, HindsightRelabel.from_env(env))


# -- ends that are not the episode's --------------------------------------------------


def test_ends_that_are_not_the_episodes_are_refused():
    """torchrl's GymEnv(num_envs=...) has zeros in `next` at the end of an episode."""
    data = name_goals(Envs(2, [10]).chunk(10)).reshape(-1)
    for key in ("achieved_goal", "desired_goal"):
        data["next", key][9] = 0
    data["next", "reward"][9] = 0
    message = r"differ in 1 of 20 rows.*\[0, 0, 0\].*GymEnv\(num_envs=.*ParallelEnv"
    with pytest.raises(ValueError, match=message):
        buffer(HindsightRelabel(reward_fn)).extend(data)


def test_the_ends_are_checked_in_every_batch_and_layout():
    envs, rb = Envs(2, [5]), buffer(HindsightRelabel(reward_fn), ndim=2)
    for _ in range(20):
        rb.extend(envs.chunk(10))
    data = envs.chunk(10)
    data["next", "desired_goal"][1, 9] = 0
    with pytest.raises(ValueError, match="differ in 1 of 20 rows"):
        rb.extend(data)


def test_goals_may_change_from_row_to_row():
    data = Envs(2, [10]).chunk(20)
    goal = -1 - torch.rand(2, 20, 3)
    data["desired_goal"], data["next", "desired_goal"] = goal, goal.clone()
    data["next", "reward"] = reward_fn(data["next", "achieved_goal"], goal)
    rb = buffer(HindsightRelabel(reward_fn))
    rb.extend(data.reshape(-1))
    assert len(rb) == 40


def test_unknown_goals_may_be_nan():
    data = Envs(2, [10]).chunk(20)
    for place in (data, data["next"]):
        place["desired_goal"][0] = torch.nan
    data["next", "reward"][0] = 0  # rewards of unknown goals are not checked
    data["next", "reward"][1] = -1  # no known goal is reached
    rb = buffer(HindsightRelabel(reward_fn))
    rb.extend(data.reshape(-1))
    assert not get_warnings(lambda: sample(rb))


@functools.cache
def record_successes():
    return datasets.generate(
        "PandaReach-v3", kind="noisy", transitions=400, seed=0, num_envs=8
    )


@pytest.mark.parametrize(
    ("options", "count"),
    [({}, 1), ({"her_ratio": 1.0}, 0), ({"terminated_fn": None}, 0)],
)
def test_episodes_that_go_on_after_success_warn_once(options, count):
    env = make("PandaReach-v3")
    data = record_successes()
    rb = buffer(HindsightRelabel.from_env(env, **options))
    rb.extend(data.reshape(-1))
    messages = get_warnings(lambda: sample(rb))
    assert len([m for m in messages if "pass terminated_fn=None" in m]) == count


# -- padding --------------------------------------------------------------------------


def make_padded():
    """Returns [trajectories, time] with padded rows, and its real rows."""
    data = Envs(3, [4, 7, 9]).chunk(40)
    padded = split_trajectories(data)
    mask = padded["collector", "mask"]
    assert not mask.all()
    return padded, padded[mask]


@pytest.mark.parametrize("strategy", ["future", "final", "random"])
@pytest.mark.parametrize("prepared", [True, False])
def test_padded_rows_are_dropped(strategy, prepared):
    padded, real = make_padded()
    transform = HindsightRelabel(reward_fn, strategy=strategy, her_ratio=1.0)
    if prepared:
        rb = buffer(transform, storage=TensorStorage(transform.prepare(padded)))
    else:
        rb = buffer(transform)
        rb.extend(padded.reshape(-1))
    stored = rb.storage[:]
    achieved = ("next", "achieved_goal")
    assert torch.equal(stored[achieved], real[achieved])
    check_batch(rb.sample(), stored, strategy, her_ratio=1.0)


def test_padding_in_two_dimensions_is_refused():
    rb = buffer(HindsightRelabel(reward_fn), ndim=2)
    with pytest.raises(RuntimeError, match="padded"):
        rb.extend(make_padded()[0])


def test_a_mask_without_padding_changes_nothing():
    data = Envs(3, [5]).chunk(10)
    data["collector", "mask"] = torch.ones(3, 10, dtype=torch.bool)
    rb = buffer(HindsightRelabel(reward_fn), ndim=2)
    rb.extend(data)
    assert len(rb) == 30
