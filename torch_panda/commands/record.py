"""Record demonstrations of the scripted experts, or generate data for offline learning.

python -m torch_panda record --env-id PandaPush-v1 --episodes 200 --out demos.pt
python -m torch_panda record --format minari --out panda/push-expert-v0
python -m torch_panda record --format lerobot --out push_lerobot
python -m torch_panda record --kind play --transitions 100000 --out push_play.pt
python -m torch_panda record --verify

By default, the command records demonstrations and prints the expert's success rate.
With ``--kind``, one of the kinds of `torch_panda.datasets.generate`, it prints the hash
of the data. With ``--verify``, it compares such hashes with the published ones.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import torch
import tyro
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from tqdm import tqdm

import torch_panda
from torch_panda.commands.evaluate import print_share
from torch_panda.datasets.formats import Writer, load_format
from torch_panda.datasets.generation import (
    PLAY_NOISE,
    Kind,
    batch_shape,
    episode_seed,
    fixed_options,
    generate,
    generate_parts,
    sha256,
)
from torch_panda.datasets.recording import TensorWriter, add_noise, play
from torch_panda.experts import make_expert
from torch_panda.learning.files import prepare, save
from torch_panda.learning.limits import Finite, Positive, Seed, Weight, check_limits
from torch_panda.learning.user_modules import Imports, import_modules

# Keys of pictures. The hash does not include them.
PIXELS = ("pixels", ("next", "pixels"))
EPISODES = 200  # default number of demonstrations
# Published hashes by number of transitions, id and kind.
PUBLISHED = Path(torch_panda.__file__).parent / "datasets" / "published.json"
VERIFY_OPTIONS = {"verify", "env_id", "kind", "transitions", "num_envs", "num_threads"}


@dataclass
class Args:
    """Record demonstrations of a scripted expert, or generate data."""

    env_id: str = "PandaPush-v1"
    """id of the environment. Experts need a Panda with end-effector control"""
    episodes: Positive | None = None
    """number of demonstrations (kind "expert"); None means 200"""
    seed: Seed = 0
    """seed of the environments and the noise (kind "expert"), or of the generated
    data"""
    num_envs: Positive = 32
    """number of environments stepped in parallel"""
    num_threads: Positive | None = None
    """number of threads that step the environments; None means one per core that the
    process may use"""
    noise_eps: Weight = 0.0
    """standard deviation of Gaussian noise on the executed actions. The file holds the
    expert's actions without noise, which correct the errors that the noise causes
    (DART, arXiv 1703.09327)"""
    task_options: dict[str, Finite] = field(default_factory=dict)
    """arguments of the task to change, such as `clearance 0.0005`"""
    format: Literal["tensors", "minari", "lerobot"] = "tensors"
    """"tensors" writes one file with a nested dict of tensors. "minari" and "lerobot"
    write a data set in the format of that library"""
    out: Path | None = None
    """file to write (tensors), id of the data set (minari) or its folder (lerobot).
    None only measures the expert's success"""
    image_size: Positive = 128
    """height and width of the pictures [pixels], which only "lerobot" has"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""
    kind: Literal["expert", Kind] = "expert"
    """demonstrations ("expert"), or data of `torch_panda.datasets.generate`: the expert
    with noise on its actions ("noisy"), the expert with smooth noise pursuing goal
    after goal without reset ("play"), or random actions ("random")"""
    play_noise: Weight = PLAY_NOISE
    """scale of the smooth noise of the kind "play"; the default is that of OGBench's
    play data"""
    transitions: Positive | None = None
    """number of generated transitions, rounded up to whole episodes; None means
    100,000, or 1,000 with `verify`"""
    verify: bool = False
    """generate published data sets of the id, write no file, and compare their hashes.
    The kind "expert" means all kinds"""


def open_writer(args: Args, out: Path, env: torch_panda.RobotTaskEnv) -> Writer:
    """Open the writer of the episodes.

    Raises:
        ValueError: The library of the format is not installed, or refuses the name.
        OSError: The data cannot be written.
    """
    if args.format == "tensors":
        return TensorWriter(out)
    return load_format(args.format).Writer(out, args.env_id, env, args.kind)


def check(args: Args) -> None:
    """Check options before recording starts.

    Raises:
        ValueError: An option is outside its limits, or two options are incompatible.
    """
    check_limits(args)
    if args.verify:
        default = asdict(Args())
        changed = {key for key, value in asdict(args).items() if value != default[key]}
        if refused := ", ".join(sorted(changed - VERIFY_OPTIONS)):
            raise ValueError(
                f"verify does not work with {refused}; published data sets have seed 0 "
                "and no other options"
            )
        return
    is_generated = args.kind != "expert"
    if is_generated and (args.episodes is not None or args.noise_eps):
        raise ValueError(
            f"episodes and noise_eps do not work with the kind {args.kind}; use "
            "transitions, or the kind expert"
        )
    if is_generated and args.out is None:
        raise ValueError(f"the kind {args.kind} needs a file or name to write, --out")
    changes_data = args.transitions is not None or args.play_noise != PLAY_NOISE
    if not is_generated and changes_data:
        raise ValueError(
            "transitions and play_noise do not work with the kind expert; use episodes "
            "and noise_eps, or another kind"
        )
    if args.noise_eps and args.format == "minari":
        raise ValueError(
            "noise_eps does not work with the format minari, whose episodes hold "
            "the executed actions"
        )
    if args.out is not None and args.format == "tensors" and args.out.is_file():
        raise ValueError(
            f"{args.out} exists already: remove it, or choose another --out"
        )
    last = args.seed + (args.episodes or EPISODES) - 1
    if not is_generated and args.format != "tensors" and last >= 2**63:
        raise ValueError(
            f"the format {args.format} stores the seeds of its episodes, from seed to "
            f"seed + episodes - 1, as 64-bit integers: they must be below 2**63, but "
            f"the last one is {last}"
        )
    if args.task_options and args.format != "tensors":
        raise ValueError(
            f"task_options do not work with the format {args.format}: its data sets "
            "store the id of the environment, but not the task_options; use the "
            "format tensors"
        )


def make_options(args: Args) -> dict[str, Any]:
    """Arguments of `torch_panda.make` that the options determine."""
    options: dict[str, Any] = {"task_options": args.task_options}
    if args.format == "lerobot":
        options |= {"from_pixels": True, "render_size": args.image_size}
    return options


def main(args: Args) -> None:
    """Record, and print what was recorded."""
    try:
        check(args)
        import_modules(args.imports)
        if args.verify:
            verify(args)
        elif args.kind == "expert":
            record_demonstrations(args)
        else:
            record_generated_data(args, args.kind)
    except (ValueError, TypeError, OSError) as error:
        raise SystemExit(str(error)) from None


def record_demonstrations(args: Args) -> None:
    """Play episodes of the expert, print its success and save the transitions.

    Raises:
        ValueError: There is no expert for the id, or the format refuses the name.
        TypeError: The task does not have one of the ``task_options``.
        OSError: The data cannot be written.
    """
    torch.manual_seed(args.seed)  # the noise uses torch's generator
    episodes = args.episodes or EPISODES
    env = torch_panda.make(
        args.env_id,
        num_envs=min(args.num_envs, episodes),
        num_threads=args.num_threads,
        seed=args.seed,
        **make_options(args),
    )
    expert: TensorDictModuleBase = make_expert(env)
    writer = None if args.out is None else open_writer(args, args.out, env)
    expert = add_noise(expert, env, args.noise_eps)
    success: list[Tensor] = []
    steps = 0
    with env, tqdm(total=episodes, unit="episode", desc=args.env_id) as bar:
        while len(success) < episodes:
            first = len(success)
            if args.format != "tensors":
                # These formats store the seed of each episode.
                for index in range(env.batch_size[0]):
                    env.set_env_seed(index, args.seed + first + index)
            new = play(env, expert)[: episodes - first]
            for index, episode in enumerate(new, first):
                success.append(episode["next", "success"])
                if writer is not None:
                    episode["action"] = episode.pop("intended")
                    writer.add(episode, args.seed + index)
                    steps += len(episode)
            bar.update(len(new))
    print(f"{args.env_id}, {episodes} episodes")
    print_share("success at the end", torch.stack([flags[-1] for flags in success]))
    print_share("success at any time", torch.stack([x.any() for x in success]))
    if writer is not None:
        print(f"{steps} transitions in {writer.close()}")


def record_generated_data(args: Args, kind: Kind) -> None:
    """Generate a data set, save it, and print its hash.

    Raises:
        ValueError: The kind does not fit the id, or the format refuses the name.
        TypeError: The task does not have one of the ``task_options``.
        OSError: The data cannot be written.
    """
    assert args.out is not None
    out = args.out
    transitions = args.transitions or 100_000
    options = make_options(args)
    num_episodes, steps = batch_shape(args.env_id, kind, transitions, **options)
    with tqdm(
        total=num_episodes * steps,
        unit="transition",
        desc=f"{args.env_id} {kind}",
    ) as bar:
        parts = generate_parts(
            args.env_id,
            kind=kind,
            transitions=transitions,
            seed=args.seed,
            num_envs=args.num_envs,
            num_threads=args.num_threads,
            play_noise=args.play_noise,
            progress=bar.update,
            **options,
        )
        if args.format == "tensors":
            prepare(out)
            data = TensorDict.cat(list(parts))
            save(out, data.to_dict())
            place = str(out)
        else:
            place, data = write_episodes(args, out, parts)
    print(f"{data.numel()} transitions in {place}")
    print(f"sha256 {sha256(data)}")


def verify(args: Args) -> None:
    """Generate data sets, and compare their hashes with the published ones.

    Raises:
        ValueError: No hash was published, or the hash of a data set differs.
    """
    transitions = args.transitions or 1_000
    published = json.loads(PUBLISHED.read_text())
    kinds = get_args(Kind) if args.kind == "expert" else (args.kind,)
    hashes = published.get(str(transitions), {}).get(args.env_id)
    if hashes is None:
        ids = ", ".join(published["1000"])
        raise ValueError(
            f"no hashes of {transitions} transitions of {args.env_id} "
            f"{', '.join(kinds)} were published; the published ids are {ids}, and the "
            f"numbers {', '.join(published)}"
        )
    different = []
    for kind in kinds:
        data = generate(
            args.env_id,
            kind=kind,
            transitions=transitions,
            seed=0,
            num_envs=args.num_envs,
            num_threads=args.num_threads,
        )
        is_equal = sha256(data) == hashes[kind]
        print(
            f"{args.env_id} {kind}, {transitions} transitions: sha256 {sha256(data)} "
            + ("as published" if is_equal else f"instead of {hashes[kind]}")
        )
        if not is_equal:
            different.append(kind)
    if different:
        raise ValueError(
            f"the hash differs from the published one: {', '.join(different)}"
        )


def write_episodes(
    args: Args, out: Path, parts: Iterable[TensorDict]
) -> tuple[str, TensorDict]:
    """Write generated episodes in the format of another library.

    Returns:
        How to read the data set, and the data without pictures [episodes, steps].
    """
    options = {**make_options(args), **fixed_options(args.kind)}
    without_pictures = []
    with torch_panda.make(args.env_id, **options) as env:
        writer = open_writer(args, out, env)
        for part in parts:
            without_pictures.append(part.exclude(*PIXELS))
            goals = part["achieved_goal"], part["desired_goal"]
            part["success"] = env.is_success(*goals)
            for episode in part:
                number = int(episode["collector", "traj_ids"][0])
                writer.add(episode, episode_seed(args.seed, number))
    return writer.close(), TensorDict.cat(without_pictures)


def run(arguments: Sequence[str]) -> None:
    """Read the options and run the command."""
    main(tyro.cli(Args, prog="python -m torch_panda record", args=arguments))
