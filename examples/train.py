"""Train DDPG, TD3, SAC or TQC with hindsight experience replay on any task.

    python examples/train.py --env-id PandaPush-v1 --algo td3 --total-steps 300000

The default preset has the hyperparameters of the panda-gym paper (arXiv 2106.13687);
where its table is silent they follow the HER of OpenAI Baselines. An iteration is one
episode of every environment, then the gradient steps due for it, so that between two
iterations a run is its weights, its buffer and its random numbers, and `--resume`
continues it bit for bit.
"""

import csv
import json
import signal
import time
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.record import CSVLogger, TensorboardLogger
from torchrl.record.loggers.common import Logger
from tqdm import tqdm

import torch_panda
from agents import Agent, Hyperparameters, read, replace, save_policy
from evaluate import evaluate
from limits import check_limits
from plot import plot_curve
from starts import StartFrom, states_at_objects
from torch_panda.transforms import HindsightAugment, HindsightRelabel
from watch import record


@dataclass
class Args(Hyperparameters):
    """What to train, how long, and where to write."""

    preset: Literal["paper", "tuned"] = "paper"
    """where the defaults of the other options are from: the paper's table, or ours"""
    env_id: str = "PandaReach-v1"
    """one of torch_panda.ENV_IDS"""
    her: Literal["relabel", "augment", "none"] = "relabel"
    """hindsight goals when sampling, as stored copies, or none"""
    her_ratio: float = 0.8
    """share of relabelled transitions, k / (k + 1): k = 4 goals per transition"""
    seed: int = 0
    """of the environments, the networks and the sampling"""
    num_envs: int = 4
    """environments that are stepped in parallel"""
    num_threads: int | None = None
    """threads that step them; None means one per core"""
    torch_threads: int = 1
    """threads of a gradient step on the CPU; more pay off only on idle cores"""
    matmul_precision: Literal["highest", "high", "medium"] = "medium"
    """torch's precision of float32 products. "medium" permits bfloat16; on CPUs with
    AVX-512 it selects oneDNN, there up to twice as fast as MKL"""
    device: str = "cpu"
    """of the networks and the replay buffer"""
    total_steps: int = 10_000
    """environment steps, over all environments; 0 after `pretrain_updates` only"""
    updates_per_step: float = 0.5
    """gradient steps per environment step"""
    batch_size: int = 256
    """transitions per gradient step"""
    demos: Path | None = None
    """transitions to learn from beside one's own, as examples/experts.py writes them"""
    demo_ratio: float = 0.25
    """share of each batch that is drawn from them"""
    demo_her_ratio: float = 0.0
    """share of those that get what their episode achieved at its end for a goal, as if
    the expert had never missed"""
    pretrain_updates: int = 0
    """gradient steps that only imitate them, before the first step of the environments;
    the learning rate falls to 0 in them"""
    anneal_lr: bool = False
    """let the learning rate fall to 0, linearly, until the last step"""
    keep_unmoved: float = 1.0
    """share of the episodes in which nothing moved that are stored (filtered HER, see
    arXiv 2012.08850): every goal that they could be given is reached without acting"""
    start_at_object: float = 0.0
    """share of the training episodes that begin with the hand at an object: holding it,
    or beside it if the gripper is blocked (see examples/starts.py)"""
    buffer_size: int = 1_000_000
    """transitions in the replay buffer"""
    eval_interval: int = 1_000
    """environment steps between evaluations"""
    eval_episodes: int = 80
    """fresh episodes per evaluation"""
    save_interval: int = 20_000
    """environment steps, or imitating gradient steps, between the states that --resume
    starts from; Ctrl-C saves one, too"""
    out: Path | None = None
    """folder of the results; None means runs/<env-id>-<algo>-<her>-<seed>"""
    resume: bool = False
    """continue the run in that folder, with the same other arguments"""
    tensorboard: bool = False
    """log to TensorBoard, too"""
    video: bool = True
    """at the end, record 6 episodes"""


PRESETS = {
    "paper": Args(),
    "tuned": Args(
        preset="tuned",
        num_envs=8,
        gamma=0.95,
        keep_unmoved=0.1,
        max_random_eps=1.0,
        relative_inputs=True,
        mirror=True,
        shift=0.15,
    ),
}
# What may differ between a run and its continuation.
FREE_ARGUMENTS = {
    "resume",
    "out",
    "num_threads",
    "tensorboard",
    "save_interval",
    "video",
}
RESULTS = ("resume.pt", "curve.csv", "checkpoint.pt")  # what a run must not overwrite
SETTLED = 4  # steps in which Slide's puck, which starts in the air, has fallen
SAVED_KEYS = [
    *("args", "agent", "optimizer", "updates", "pretrained", "buffer", "demos"),
    *("random", "cuda_random", "curve", "steps", "seconds"),
]
STORED_KEYS = [
    "observation",
    "desired_goal",
    "action",
    ("collector", "traj_ids"),
    ("next", "observation"),
    ("next", "achieved_goal"),
    ("next", "desired_goal"),
    ("next", "reward"),
    ("next", "terminated"),
    ("next", "done"),
]


class Run:
    """A training: what it is made of, and what a continuation needs to know."""

    def __init__(self, args: Args, out: Path) -> None:
        self.args = args
        self.out = out
        self.env = torch_panda.make(
            args.env_id,
            num_envs=args.num_envs,
            num_threads=args.num_threads,
            device=args.device,
        )
        self.eval_env = torch_panda.make(
            args.env_id,
            num_envs=min(16, args.eval_episodes),
            num_threads=args.num_threads,
            device=args.device,
        )
        torch.set_num_threads(args.torch_threads)
        torch.set_float32_matmul_precision(args.matmul_precision)
        torch.manual_seed(args.seed)
        self.agent = Agent(
            self.env,
            args,
            max_episode_steps=self.env.max_episode_steps,
            sparse="Dense" not in args.env_id,
        ).to(args.device)
        self.buffer = make_buffer(args, self.env)
        self.demos: TensorDictReplayBuffer | None = None
        self.num_demos = 0  # of each batch
        if args.demos is not None:
            demos = read_demos(args.demos, self.env)
            self.demos = TensorDictReplayBuffer(
                storage=LazyTensorStorage(len(demos), device=args.device),
                transform=HindsightRelabel.from_env(
                    self.env,
                    success_fn=None,
                    her_ratio=args.demo_her_ratio,
                    strategy="final",
                    seed=args.seed,
                ),
            )
            self.agent.normalizer.update(demos["observation"], demos["desired_goal"])
            self.demos.extend(demos)
            self.num_demos = round(args.demo_ratio * args.batch_size)
            if self.num_demos >= args.batch_size:
                raise ValueError(
                    f"a demo_ratio of {args.demo_ratio} leaves no room for transitions "
                    f"of one's own in a batch of {args.batch_size}"
                )
        self.pretrained = 0  # gradient steps
        self.curve: list[dict[str, float]] = []
        self.steps = 0
        self.seconds = 0.0
        # Made before `load`, because making it draws random numbers.
        self.collector = self.make_collector()

    def train(self, stop: "StopSignal | None" = None) -> bool:
        """Collect, learn and evaluate until the last step, or until told to stop.

        Returns:
            whether the last step was reached.
        """
        args, out = self.args, self.out
        loggers: list[Logger] = [CSVLogger("log", log_dir=str(out))]
        if args.tensorboard:
            loggers.append(TensorboardLogger("tensorboard", log_dir=str(out)))
        started = time.perf_counter() - self.seconds
        if not self.pretrain(stop):
            return False
        if self.steps >= args.total_steps:  # none wanted, or resumed at the end
            return True
        progress = tqdm(
            initial=self.steps,
            total=args.total_steps,
            unit="step",
            desc=f"{args.env_id} {args.algo}",
        )
        self.show(progress)
        self.reseed(self.env)
        for data in self.collector:
            before, self.steps = self.steps, self.steps + data.numel()
            losses = self.learn(data)
            progress.update(data.numel())
            self.seconds = time.perf_counter() - started
            finished = self.steps >= args.total_steps
            if finished or crossed(args.eval_interval, before, self.steps):
                self.evaluate()
                self.show(progress)
                for logger in loggers:
                    for key, value in {**self.curve[-1], **losses}.items():
                        logger.log_scalar(key, value, step=self.steps)
            if finished or stop or crossed(args.save_interval, before, self.steps):
                replace(out / "resume.pt", self.save)
            if finished or stop:
                break
            self.reseed(self.env)
        progress.close()
        return self.steps >= args.total_steps

    def pretrain(self, stop: "StopSignal | None") -> bool:
        """Imitate the demonstrations, if asked to, and evaluate.

        Returns:
            whether this is done.
        """
        count, batch_size = self.args.pretrain_updates, self.args.batch_size
        if self.pretrained == count:
            return True
        assert self.demos is not None
        started = time.perf_counter() - self.seconds
        progress = tqdm(
            initial=self.pretrained, total=count, unit="update", desc="imitation"
        )
        while self.pretrained < count and not stop:
            self.set_learning_rate(1 - self.pretrained / count)
            loss = self.agent.imitate(self.demos.sample(batch_size))
            self.pretrained += 1
            progress.update()
            if self.pretrained % 1000 == 0:
                progress.set_postfix(loss=f"{loss:.2g}")
            due = self.pretrained % self.args.save_interval == 0
            if due and self.pretrained < count:  # the end is saved below
                self.seconds = time.perf_counter() - started
                replace(self.out / "resume.pt", self.save)
        progress.close()
        self.set_learning_rate(1.0)
        self.seconds = time.perf_counter() - started
        if self.pretrained == count:
            self.evaluate()
        replace(self.out / "resume.pt", self.save)
        return self.pretrained == count

    def make_collector(self) -> Collector:
        """Whole episodes of all environments, one batch [num_envs, steps] each time."""
        env: EnvBase = self.env
        if self.args.start_at_object:
            states = states_at_objects(self.args.env_id, seed=self.args.seed)
            start = StartFrom(states, self.args.start_at_object)
            env = TransformedEnv(env, start)
        return Collector(
            env,
            self.agent.explore,
            frames_per_batch=self.args.num_envs * self.env.max_episode_steps,
            total_frames=-1,
            reset_at_each_iter=True,
            exploration_type=ExplorationType.RANDOM,
            auto_register_policy_transforms=True,
        )

    def learn(self, data: TensorDictBase) -> dict[str, float]:
        """Store the episodes and take the gradient steps that are due for them.

        Returns:
            the mean of each loss.
        """
        # The next batch begins with a reset: an episode that is not over is cut here.
        data["next", "done"][:, -1] = True
        data = data.select(*STORED_KEYS)
        if self.args.keep_unmoved < 1:
            lucky = torch.rand(len(data)) < self.args.keep_unmoved
            data = data[moved(data) | lucky.to(data.device)]
            if not len(data):
                return {}
        stored = self.buffer[self.buffer.extend(data.reshape(-1))]
        # As in Baselines, the statistics are of relabelled episodes.
        self.agent.normalizer.update(stored["observation"], stored["desired_goal"])
        due = int(self.steps * self.args.updates_per_step) - self.agent.updates
        losses: dict[str, list[Tensor]] = {}
        for _ in range(due):
            if self.args.anneal_lr:
                last = self.args.updates_per_step * self.args.total_steps
                # The last iteration may go beyond the last step.
                self.set_learning_rate(max(0.0, 1 - self.agent.updates / last))
            for key, loss in self.agent.update(*self.sample()).items():
                losses.setdefault(key, []).append(loss)
        return {key: float(torch.stack(x).mean()) for key, x in losses.items()}

    def set_learning_rate(self, share: float) -> None:
        """Let the next gradient steps have so much of the learning rate."""
        for group in self.agent.optimizer.param_groups:
            group["lr"] = share * self.args.learning_rate

    def sample(self) -> list[TensorDictBase]:
        """A batch of the run's own transitions, and one of demonstrations if any."""
        batches = [self.buffer.sample(self.args.batch_size - self.num_demos)]
        if self.demos is not None and self.num_demos:
            batches.append(self.demos.sample(self.num_demos))
        return batches

    def evaluate(self) -> None:
        """Add a point to the curve, and write and draw it."""
        self.reseed(self.eval_env)
        result = evaluate(self.eval_env, self.agent.policy, self.args.eval_episodes)
        row = {
            "step": self.steps,
            "success": float(result.success.float().mean()),
            "ever_success": float(result.ever.float().mean()),
            "return": float(result.episode_return.mean()),
            "updates": self.agent.updates,
            "seconds": round(self.seconds, 2),
        }
        self.curve.append(row)
        with (self.out / "curve.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(row))
            writer.writeheader()
            writer.writerows(self.curve)
        plot_curve(self.curve, self.args.env_id, self.out / "curve.png")
        save_policy(self.out / "checkpoint.pt", self.agent, self.args.env_id)

    def reseed(self, env: torch_panda.RobotTaskEnv) -> None:
        """Make the next episodes follow from the random state that is saved."""
        env.set_seed(int(torch.randint(2**62, ())))

    def show(self, progress: tqdm) -> None:
        """Show the last success rate beside the progress."""
        if self.curve:
            progress.set_postfix(success=f"{self.curve[-1]['success']:.0%}")

    def save(self, path: Path) -> None:
        """Write all that changes in a run."""
        state = {
            "args": fixed(self.args),
            "agent": self.agent.state_dict(),
            "optimizer": self.agent.optimizer.state_dict(),
            "updates": self.agent.updates,
            "pretrained": self.pretrained,
            "buffer": self.buffer.state_dict(),
            "demos": None if self.demos is None else self.demos.state_dict(),
            "random": torch.get_rng_state(),
            "cuda_random": torch.cuda.get_rng_state_all(),
            "curve": self.curve,
            "steps": self.steps,
            "seconds": self.seconds,
        }
        torch.save(state, path)

    def load(self, path: Path) -> None:
        """Take what `save` wrote.

        Raises:
            ValueError: it is the state of a run with other arguments, or damaged.
        """
        state = read(path, "the state of a run", SAVED_KEYS)
        ours, theirs = fixed(self.args), state["args"]
        differing = [
            f"{key} was {theirs.get(key)!r}, is {value!r}"
            for key, value in ours.items()
            if theirs.get(key) != value
        ]
        if differing:
            raise ValueError(f"cannot resume {path.parent}: {'; '.join(differing)}")
        self.agent.load_state_dict(state["agent"])
        self.agent.optimizer.load_state_dict(state["optimizer"])
        self.agent.updates = state["updates"]
        self.pretrained = state["pretrained"]
        self.buffer.load_state_dict(state["buffer"])
        if self.demos is not None:
            self.demos.load_state_dict(state["demos"])
        torch.set_rng_state(state["random"])
        torch.cuda.set_rng_state_all(state["cuda_random"])
        self.curve = state["curve"]
        self.steps = state["steps"]
        self.seconds = state["seconds"]

    def close(self) -> None:
        """Free the environments."""
        self.collector.shutdown()
        self.eval_env.close()


class StopSignal:
    """True after Ctrl-C or a SIGTERM; a second one ends the program as usual."""

    def __init__(self) -> None:
        self.received = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._receive)

    def _receive(self, number: int, frame: object) -> None:
        self.received = True
        self.release()
        tqdm.write("stopping after this iteration; again to stop at once")

    def release(self) -> None:
        """Let the signals act as usual."""
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def __bool__(self) -> bool:
        return self.received


def read_demos(path: Path, env: torch_panda.RobotTaskEnv) -> TensorDictBase:
    """Transitions (n,) of whole episodes.

    Raises:
        ValueError: the file holds none, or none of such an environment.
    """
    content = read(path, "demonstrations", STORED_KEYS)
    try:
        demos = TensorDict(content, [len(content["action"])]).select(*STORED_KEYS)
    except (RuntimeError, TypeError) as error:  # other lengths, or no tensors
        raise ValueError(f"{path} does not hold demonstrations: {error}") from None
    if not len(demos):
        raise ValueError(f"{path} holds no transitions")
    for key in ("observation", "action", "desired_goal"):
        expected = env.full_observation_spec.get(key, None)
        size = (env.action_spec if expected is None else expected).shape[-1]
        if demos[key].shape[-1] != size:
            raise ValueError(
                f"{path}: {key} has size {demos[key].shape[-1]}, the task's has {size}"
            )
    return demos.to(env.device)


def make_buffer(args: Args, env: torch_panda.RobotTaskEnv) -> TensorDictReplayBuffer:
    """The replay buffer with the chosen kind of hindsight."""
    iteration = args.num_envs * env.max_episode_steps
    capacity = min(args.buffer_size, args.total_steps + iteration)
    transform: HindsightRelabel | HindsightAugment | None = None
    if args.her == "relabel":
        transform = HindsightRelabel.from_env(
            env, success_fn=None, her_ratio=args.her_ratio, seed=args.seed
        )
    elif args.her == "augment":
        k = round(args.her_ratio / (1 - args.her_ratio))
        transform = HindsightAugment.from_env(env, success_fn=None, k=k, seed=args.seed)
        capacity *= k + 1
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity, device=args.device), transform=transform
    )


def moved(data: TensorDictBase) -> Tensor:
    """Which episodes [num_envs, steps] saw their achieved goal change, (num_envs,).

    By more than 1 cm (or 0.01 in a quaternion) after the objects have settled.
    """
    goal = data["next", "achieved_goal"]
    return ((goal - goal[:, SETTLED : SETTLED + 1]).abs() > 0.01).flatten(1).any(1)


def crossed(interval: int, before: int, after: int) -> bool:
    """Whether a multiple of ``interval`` lies in (before, after]."""
    return before // interval < after // interval


def fixed(args: Args) -> dict[str, Any]:
    """The arguments that a continuation must share."""
    every = json.loads(json.dumps(asdict(args), default=str))
    return {key: value for key, value in every.items() if key not in FREE_ARGUMENTS}


def check(args: Args, out: Path) -> None:
    """Refuse options that would end the training later.

    Raises:
        ValueError: says which, and what is accepted.
    """
    check_limits(args)
    if args.pretrain_updates and args.demos is None:
        raise ValueError("pretrain_updates needs demos to imitate")
    if not args.total_steps and not args.pretrain_updates:
        raise ValueError("total_steps must be positive without pretrain_updates, got 0")
    if args.her == "augment" and not 1 / 3 < args.her_ratio < 1:
        raise ValueError(
            "with --her augment, which stores her_ratio / (1 - her_ratio) copies, "
            f"her_ratio must be above 1/3 and below 1, got {args.her_ratio}"
        )
    if args.resume and not (out / "resume.pt").exists():
        raise ValueError(f"there is no run to resume in {out}")
    if not args.resume and any((out / name).exists() for name in RESULTS):
        raise ValueError(
            f"{out} holds a run: continue it with --resume, remove it, or choose "
            "another folder with --out"
        )
    if out.exists() and not out.is_dir():
        raise ValueError(f"out must be a folder, got the file {out}")
    if args.tensorboard and find_spec("tensorboard") is None:
        raise ValueError("--tensorboard needs another package: pip install tensorboard")
    try:
        torch.zeros(1, device=args.device).item()
    except (RuntimeError, AssertionError, ImportError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            "device must be one that torch can use here, such as cpu, "
            f"got {args.device!r}: {reason}"
        ) from None


def main(args: Args) -> None:
    """Train, and say where the results are."""
    out = args.out or Path("runs") / f"{args.env_id}-{args.algo}-{args.her}-{args.seed}"
    try:
        check(args, out)
        run = Run(args, out)
        if args.resume:
            run.load(out / "resume.pt")
        out.mkdir(parents=True, exist_ok=True)
        (out / "args.json").write_text(json.dumps(asdict(args), default=str, indent=2))
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from None
    stop = StopSignal()
    finished = run.train(stop)
    stop.release()
    run.close()
    if finished and args.video:
        with torch_panda.make(
            args.env_id, num_envs=6, seed=args.seed, device=args.device
        ) as env:
            try:
                record(env, run.agent.policy, out / "video.mp4")
            except KeyboardInterrupt:
                print("no video")
    if run.curve:
        success = run.curve[-1]["success"]
        print(f"success {success:.0%} after {run.steps} steps; see {out}")
    if not finished:
        print(f"stopped and saved in {out}: the same command with --resume goes on")


if __name__ == "__main__":
    # Parsed twice: the preset says what the other options default to.
    preset = tyro.cli(Args).preset
    main(tyro.cli(Args, default=PRESETS[preset]))
