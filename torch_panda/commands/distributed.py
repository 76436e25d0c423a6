"""Train on the machines of a Ray cluster, with many workers and one learner.

    python -m torch_panda distributed --num-workers 4 --cpus-per-worker 8 --address auto

Each worker steps `num_envs` environments in `cpus_per_worker` threads and sends its
transitions to the learner. When a batch of a worker arrives, the learner adds it to
one replay buffer for all workers, takes gradient steps, and sends the new weights back
to that worker. The other workers continue meanwhile, and batches arrive in varying
order. So two runs with the same seed differ.

Without `--address` the workers run on this machine. The guide learning/README.md says
how to start a cluster of machines.
"""

import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import ray
import torch
import tyro
from ray.exceptions import RayActorError
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors.distributed import RayCollector
from torchrl.envs.utils import ExplorationType
from tqdm import tqdm
from tyro.conf import Suppress

import torch_panda
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.agents.hyperparameters import ActorGoal, Critics, OnlineAlgo
from torch_panda.learning.buffers import STORED_KEYS, make_buffer
from torch_panda.learning.evaluation.curve import Curve, draw_seed
from torch_panda.learning.files.run_files import (
    Progress,
    check_folder,
    lock_folder,
    write_options,
)
from torch_panda.learning.limits import Positive, Seed, Weight, check_limits
from torch_panda.learning.options import CRL_OPTIONS, check_exploration
from torch_panda.learning.training import StopSignal, crossed
from torch_panda.learning.user_modules import Imports, import_modules

TRAJECTORY_KEY = ("collector", "traj_ids")


@dataclass
class Args(Hyperparameters):
    """Train on the machines of a Ray cluster."""

    algo: OnlineAlgo = "ddpg"
    """algorithm: DDPG, TD3, SAC or CRL"""
    # The workers step environments, so the options of offline agents have no effect.
    # The buffer has no rewards for critics of parts.
    offline: Suppress[bool] = False
    critics: Suppress[Critics] = "whole"
    actor_goal: Suppress[ActorGoal] = "future"
    alpha: Suppress[float | None] = None

    address: str = "local"
    """address of the Ray cluster; "local" starts one on this machine for this run,
    "auto" joins the cluster to which this machine belongs"""
    env_id: str = "PandaReach-v1"
    """id of the environment, shipped or registered by --import"""
    num_workers: Positive = 2
    """number of worker processes, spread over the machines"""
    num_envs: Positive = 8
    """number of environments of each worker"""
    steps_per_batch: Positive = 50
    """steps of each environment per batch that a worker sends"""
    cpus_per_worker: Positive = 1
    """CPUs that each worker reserves, which is also its number of threads"""
    total_steps: Positive = 10_000
    """environment steps of all workers together"""
    updates_per_step: Weight = 0.5
    """gradient steps per environment step"""
    batch_size: Positive = 256
    """transitions per gradient step"""
    eval_interval: Positive = 1_000
    """environment steps between evaluations"""
    seed: Seed = 0
    """seed of the environments, the networks and the sampling"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own. Ray copies
    a file to the machines of the workers, but not the modules that it imports"""
    out: Path | None = None
    """folder of the results; None means runs/<env-id>-<algo>-distributed-<seed>"""

    @property
    def batch_frames(self) -> int:
        """Number of transitions in a batch of one worker."""
        return self.num_envs * self.steps_per_batch


class Learner:
    """The agent, the replay buffer that it learns from, and the workers that fill it.

    Attributes:
        collector: Iterator over the batches [num_envs, steps_per_batch] of all workers,
            in the order in which they arrive.
    """

    def __init__(self, args: Args, out: Path) -> None:
        torch.manual_seed(args.seed)
        self.args = args
        # The exploration noise of the agent has the batch size of a worker.
        self.env = torch_panda.make(args.env_id, num_envs=args.num_envs)
        self.agent = make_agent(self.env, args)
        capacity = args.total_steps + args.batch_frames
        goal_options = CRL_OPTIONS if args.algo == "crl" else {}
        self.buffer = make_buffer(
            self.env,
            capacity,
            discount=self.agent.gamma,
            seed=args.seed,
            **goal_options,
        )
        self.progress = Progress()
        self.curve = Curve(args.env_id, self.agent, out, device="cpu")
        self.collector = make_collector(args, self.agent.explore)

    def train(self, stop: object = False) -> None:
        """Collect and learn until the last step, or until ``stop`` is true.

        Raises:
            RayActorError: A worker died.
        """
        args, progress = self.args, self.progress
        label = f"{args.env_id} {args.algo}"
        self.curve.add(progress)  # the untrained policy
        with tqdm(total=args.total_steps, unit="step", desc=label) as bar:
            for data in self.collector:
                before, progress.steps = progress.steps, progress.steps + data.numel()
                self.learn(data)
                # `make_unique` has put the number of the worker into the ids.
                worker = int(data[TRAJECTORY_KEY].flatten()[0]) % args.num_workers
                self.send_weights(worker)
                bar.update(data.numel())
                last = progress.steps >= args.total_steps or bool(stop)
                if last or crossed(args.eval_interval, before, progress.steps):
                    self.curve.add(progress)
                    bar.set_postfix(success=progress.success)
                if last:
                    break

    def learn(self, data: TensorDictBase) -> None:
        """Store a worker's batch, and take the gradient steps that are then due."""
        stored = self.buffer[self.buffer.extend(data.reshape(-1))]
        self.agent.normalizer.update(stored["observation"], stored["desired_goal"])
        due = int(self.progress.steps * self.args.updates_per_step) - self.agent.updates
        for _ in range(due):
            self.agent.update(self.buffer.sample(self.args.batch_size))

    def send_weights(self, worker: int) -> None:
        """Send a worker the weights and the normaliser for its next batch."""
        weights = TensorDict.from_module(self.agent.explore).data
        # These two modules are the normaliser and the actor. The others hold the state
        # of the worker's own exploration, such as the point to which its hand moves.
        weights = weights.select(("module", "0"), ("module", "1"))
        # The worker waits until the learner has finished this batch, so this takes only
        # milliseconds.
        remote = self.collector.remote_collectors[worker]
        ray.get(remote.update_policy_weights_.remote(weights))

    def close(self) -> None:
        """Stop the workers and free the environments."""
        self.collector.shutdown()
        self.curve.close()
        self.env.close()


def make_unique(
    data: TensorDictBase, *, worker: int, num_workers: int
) -> TensorDictBase:
    """Give the trajectories of all workers different ids, and drop unneeded entries.

    Each worker counts its trajectories from 0. In a buffer of several workers,
    hindsight would take two trajectories with the same id for one, and mix their goals.
    So trajectory t of worker w gets the id t * num_workers + w.
    """
    data = data.select(*STORED_KEYS)
    return data.set(TRAJECTORY_KEY, data[TRAJECTORY_KEY] * num_workers + worker)


def make_env(args: Args, seed: int) -> torch_panda.RobotTaskEnv:
    """Make a worker's environments, and seed them and its exploration noise."""
    # Ray has copied the files of a user into a folder of `sys.path`.
    names = [Path(x).stem if x.endswith(".py") else x for x in args.imports]
    import_modules(names)
    torch.manual_seed(seed)
    return torch_panda.make(
        args.env_id,
        num_envs=args.num_envs,
        num_threads=args.cpus_per_worker,
        seed=seed,
    )


def make_collector(args: Args, policy: TensorDictModuleBase) -> RayCollector:
    """Start the workers on the machines of the cluster, each with a seed of its own."""
    workers = range(args.num_workers)
    # torchrl would send weights through a process group at the address that this
    # machine's name resolves to. This is often 127.0.0.1, which other machines cannot
    # reach. So `send_weights` uses Ray instead, and torchrl's warning is ignored.
    warnings.filterwarnings("ignore", message="RayCollector iteration started before")
    return RayCollector(
        [partial(make_env, args, draw_seed()) for _ in workers],  # type: ignore[arg-type]
        policy,
        frames_per_batch=args.batch_frames,
        total_frames=args.total_steps,
        exploration_type=ExplorationType.RANDOM,
        collector_kwargs=[
            {
                "postproc": partial(
                    make_unique, worker=worker, num_workers=args.num_workers
                ),
                "auto_register_policy_transforms": True,
            }
            for worker in workers
        ],
        remote_configs={
            "num_cpus": args.cpus_per_worker,
            "scheduling_strategy": "SPREAD",
        },
        weight_sync_schemes={},
    )


def connect(args: Args) -> None:
    """Join the cluster, or start one on this machine.

    Raises:
        ConnectionError: There is no cluster at the address.
        ValueError: The cluster does not have enough CPUs for the workers.
    """
    local = args.address == "local"
    files = [name for name in args.imports if name.endswith(".py")]
    ray.init(
        address=args.address,
        num_cpus=args.num_workers * args.cpus_per_worker if local else None,
        include_dashboard=False if local else None,
        runtime_env={"py_modules": files} if files else None,
        logging_level=logging.WARNING,
        log_to_driver=False,  # each line would start with the long repr of a collector
    )
    room = sum(
        int(node["Resources"].get("CPU", 0)) // args.cpus_per_worker
        for node in ray.nodes()
        if node["Alive"]
    )
    if room < args.num_workers:
        raise ValueError(
            f"the cluster has CPUs for {room} workers with {args.cpus_per_worker} CPUs "
            f"each, not for {args.num_workers}: lower num_workers or cpus_per_worker"
        )


def main(args: Args) -> None:
    """Train, and print where the results are."""
    out = args.out or Path(f"runs/{args.env_id}-{args.algo}-distributed-{args.seed}")
    try:
        check_limits(args)
        import_modules(args.imports)
        check_exploration(args, args.num_envs)
        check_folder(out, resume=False)
        connect(args)
        learner = Learner(args, out)
        # Plots need not name the options that say on which machines a run was computed.
        default = Args(
            env_id=args.env_id,
            address=args.address,
            cpus_per_worker=args.cpus_per_worker,
        )
        with lock_folder(out):
            write_options(out, args, default, preset="distributed")
            learner.train(StopSignal())
        learner.close()
    except (OSError, ValueError) as error:
        raise SystemExit(str(error)) from None
    except RayActorError as error:
        raise SystemExit(f"a worker died: {error}") from None
    finally:
        ray.shutdown()  # stops the workers, and a cluster that was started here
    progress = learner.progress
    print(f"success {progress.success} after {progress.steps} steps; see {out}")


def run(arguments: Sequence[str]) -> None:
    """Read the options and run the command."""
    main(tyro.cli(Args, prog="python -m torch_panda distributed", args=arguments))
