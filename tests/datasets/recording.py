"""Records small data sets."""

from pathlib import Path

from torch_panda.commands import record as record_demos


def record(format, out, env_id, episodes, seed=0, **options):
    record_demos.main(
        record_demos.Args(
            env_id, episodes, seed, num_envs=8, format=format, out=Path(out), **options
        )
    )
