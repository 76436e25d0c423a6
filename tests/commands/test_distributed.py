"""The distributed command, on a Ray cluster of two nodes on this machine."""

import json

import pytest
import torch

from tests.commands.runs import MODULE, read_curve
from torch_panda import registry
from torch_panda.commands import plot
from torch_panda.learning.agents.exploration import WARM_UP
from torch_panda.learning.evaluation import curve

pytestmark = pytest.mark.slow
ray = pytest.importorskip("ray")
distributed = pytest.importorskip("torch_panda.commands.distributed")

IDS = ("collector", "traj_ids")
# Ray's workers are nice by default: on a busy machine they would hardly run.
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
    "OMP_NUM_THREADS": "1",
}


@pytest.fixture(scope="module")
def address():
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 200 * 2**20}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in QUIET.items():
            patch.setenv(name, value)
        cluster = Cluster(
            initialize_head=True, head_node_args={**node, "include_dashboard": False}
        )
        cluster.add_node(**node)
        yield cluster.address
        cluster.shutdown()


@pytest.fixture
def start(address, tmp_path, monkeypatch):
    """Make a learner with two workers, one on each node."""
    learners = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)

    def start(**options):
        args = distributed.Args(
            address=address, num_envs=4, eval_interval=10**6, **options
        )
        distributed.connect(args)
        learners.append(distributed.Learner(args, tmp_path))
        return learners[0]

    monkeypatch.setattr(curve, "EPISODES", 4)
    monkeypatch.setattr(curve, "NUM_ENVS", 4)
    yield start
    for learner in learners:
        learner.close()
    ray.shutdown()
    torch.set_num_threads(threads)


def goals_of_others(buffer, true_ids):
    """Which relabelled rows of a few samples have another trajectory's goal."""
    stored = buffer.storage[:]
    batch = torch.cat([buffer.sample(256) for _ in range(4)])
    row = batch["index"]
    goal = batch["desired_goal"]
    relabelled = (goal != stored["desired_goal"][row]).any(-1)
    reached = (goal[:, None] == stored["next", "achieved_goal"]).all(-1)
    own = true_ids[row][:, None] == true_ids
    return ~(reached & own).any(-1)[relabelled]


def test_workers_fill_one_buffer(start, tmp_path):
    learner = start(total_steps=800, steps_per_batch=20, updates_per_step=0.1)
    # One CPU each and none left: the workers are on different nodes.
    assert len(ray.nodes()) == 2
    assert ray.available_resources().get("CPU", 0) == 0
    first = {k: v.clone() for k, v in learner.agent.explore.state_dict().items()}
    learner.train()

    assert learner.progress.steps == 800
    assert [row["step"] for row in learner.progress.curve] == [0, 800]
    assert learner.agent.updates == 80
    assert (tmp_path / "checkpoint.pt").exists()
    stored = learner.buffer.storage[:]
    assert len(stored) == 800
    ids, lengths = stored[IDS].unique(return_counts=True)
    assert lengths.max() == 50  # an episode is in three batches or more
    assert set((ids % 2).tolist()) == {0, 1}
    goals = [
        set(map(tuple, stored["desired_goal"][stored[IDS] % 2 == worker].tolist()))
        for worker in range(2)
    ]
    assert not goals[0] & goals[1], "two workers with one seed"

    # The worker of the last batch has got the learner's weights and normaliser.
    current = learner.agent.explore.state_dict()
    theirs = [s["policy_state_dict"] for s in learner.collector.state_dict()]
    assert any(same(weights, current) for weights in theirs)
    assert not any(same(weights, first) for weights in theirs)

    others = goals_of_others(learner.buffer, stored[IDS])
    assert len(others) > 512
    assert not others.any()


def same(weights, other):
    return all(torch.equal(value, other[key]) for key, value in weights.items())


def test_new_weights_keep_the_state_of_exploration(start):
    learner = start(
        exploration="points",
        num_workers=1,
        steps_per_batch=20,
        total_steps=160,
        updates_per_step=0.0,
    )
    learner.train()
    (state,) = learner.collector.state_dict()
    # The constructor of the worker's collector takes one step, as in `train`.
    steps = WARM_UP - int(state["policy_state_dict"]["module.3.warm_up_left"])
    assert steps >= 160 // 4


def test_a_dead_worker_is_an_error(start, tmp_path):
    learner = start(total_steps=100_000, updates_per_step=0.0)
    ray.kill(learner.collector.remote_collectors[1])
    with pytest.raises(ray.exceptions.RayActorError):
        learner.train()


def test_too_small_a_cluster_is_an_error(address):
    with pytest.raises(
        ValueError, match="CPUs for 0 workers with 2 CPUs each, not for 2"
    ):
        distributed.connect(distributed.Args(address=address, cpus_per_worker=2))
    ray.shutdown()


def test_another_run_is_not_overwritten(tmp_path, monkeypatch):
    monkeypatch.setattr(distributed, "connect", pytest.fail)
    (tmp_path / "curve.csv").write_text("theirs")
    with pytest.raises(SystemExit, match=f"^{tmp_path} holds a run: "):
        distributed.main(distributed.Args(out=tmp_path))
    assert (tmp_path / "curve.csv").read_text() == "theirs"


@pytest.mark.usefixtures("quick")
def test_workers_know_the_task_of_a_users_file(address, tmp_path, monkeypatch):
    """Also, `plot` draws the run."""
    # Not in the current folder, from which workers on the same machine could import it.
    file = tmp_path / "far_task.py"
    file.write_text(MODULE)
    known = dict(registry._REGISTRATIONS)
    monkeypatch.setattr(registry, "_REGISTRATIONS", known)
    out, sizes = tmp_path / "run", {"num_envs": 4, "steps_per_batch": 5}
    options = {**sizes, "total_steps": 40, "updates_per_step": 0.25, "out": out}
    user = {"env_id": "Near-v0", "imports": (str(file),)}
    distributed.main(distributed.Args(address=address, **options, **user))
    assert [row["step"] for row in read_curve(out)] == ["0", "40"]
    written = json.loads((out / "args.json").read_text())
    assert (written["env_id"], written["total_steps"]) == ("Near-v0", 40)
    ((line, (drawn,)),) = plot.read_runs([tmp_path])["Near-v0"].items()
    label = "distributed, num envs 4, steps per batch 5, updates per step 0.25"
    assert line == f"DDPG, {label}"
    assert [row["step"] for row in drawn] == [0, 40]
