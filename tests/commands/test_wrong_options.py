"""Wrong options end a command with one line, before it writes anything."""

import pytest

from torch_panda.commands import main

DATA = ["--kind", "noisy", "--out", "data.pt"]
DEMOS = ["--demos", "nofile.pt"]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("command", "options", "message"),
    [
        ("train", ["--env-id", "PandaFly-v1"], "unknown environment id 'PandaFly-v1'"),
        ("train", ["--resume"], "there is no run to resume"),
        ("train", ["--total-steps", "0"], "total_steps must be positive"),
        ("train", DEMOS, r"there is no file or folder nofile\.pt: "),
        ("train", ["--pretrain-updates", "9"], "needs demonstrations: pass --demos"),
        ("train", [*DEMOS, "--batch-size", "3"], "must be at least 4 with demos"),
        (
            "train",
            ["--noise-eps", "0", "--random-eps", "0", "0"],
            "algo ddpg explores by noise_eps and random_eps",
        ),
        (
            "train",
            ["--algo", "crl", "--her", "relabel"],
            "--her geometric --desired-ratio 0",
        ),
        ("train", ["--algo", "crl", *DEMOS], "algo crl cannot use demonstrations"),
        ("train", ["--her", "parts"], "--her parts needs goals of several objects"),
        ("train", ["--critics", "parts"], 'critics "parts" needs goals of several obj'),
        (
            "train",
            ["--env-id", "PandaStack-v1", "--critics", "parts", "--algo", "td3"],
            "critics parts needs algo ddpg, got td3: pass --critics whole",
        ),
        ("train", ["--task-options", "goal", "1"], "unexpected keyword .* 'goal'"),
        (
            "train",
            ["--task-options", "goal_range", "nan"],
            "task_options must be finite",
        ),
        ("train", ["--out", "/dev/null"], "out must be a folder, got the file"),
        ("train", ["--import", "no.py"], r"cannot import the file no\.py: .*No such"),
        *(
            ("train", arguments.split(), message)
            for arguments, message in (
                ("--offline --algo ddpg", "learns by gcbc, .* got --algo ddpg"),
                ("--algo hiql", "^hiql learns offline: add --offline$"),
                ("--offline --data nofile.pt", "must be one of noisy, play, random"),
                ("--offline --alpha -1", "alpha must be at least 0 and finite"),
                ("--offline --algo gcbc --alpha 1", "gcbc has no alpha: drop --alpha"),
                ("--offline --noise-eps 0", "has no effect with --offline: drop --n"),
                ("--offline --seeds 1 1", "seeds must differ, got 1, 1"),
                ("--offline --seeds 1 2 --seed 3", "seed has no effect with --seeds"),
                ("--offline --seeds 1 2 --stop-when-solved", "drop --stop-when-solved"),
                ("--offline --preset recipe", "^--offline goes with the preset off"),
                ("--offline --data . --num-envs 3", "no effect with the data of .: dr"),
                ("--offline --data . --transitions 9", "no effect .*--transitions$"),
                ("--seeds 1 2", "no effect without --offline: drop --seeds"),
                ("--alpha 1", "no effect without --offline: drop --alpha"),
                ("--offline --env-id PandaFly-v1", "unknown environment id"),
            )
        ),
        ("evaluate", ["nothing"], "no policy 'nothing': pass .* PandaPush-v1"),
        ("evaluate", ["nothing", "--episodes", "0"], "^episodes must be .*, got 0$"),
        (
            "evaluate",
            ["nothing", "--task-options", "clearance", "nan"],
            "^task_options must be .*, got .*nan",
        ),
        (
            "evaluate",
            ["PandaReach-v1", "--env-id", "PandaPush-v1", "--episodes", "1"],
            "where observation has size 6, got 18",
        ),
        ("evaluate", ["run", "--import", "no"], "'no': there is no such module; --imp"),
        ("watch", ["--env-id", "PandaFly-v1"], "unknown environment id 'PandaFly-v1'"),
        ("watch", ["--port", "0"], "^port must be .*, got 0$"),
        ("watch", ["--port", "65536"], "^port must be .*, got 65536$"),
        ("watch", ["--human", "--web"], "human and web .*: pass one of them"),
        ("watch", ["--out", "a.txt"], r"must end in \.mp4 or \.gif, got 'a\.txt'"),
        ("watch", ["--env-id", "PandaPushJoints-v1"], "no expert for 'PandaPushJoints"),
        ("record", ["--episodes", "0"], "^episodes must be .*, got 0$"),
        (
            "record",
            ["--verify", "--env-id", "PandaDrawer-v1"],
            "no hashes of 1000 transitions of PandaDrawer",
        ),
        (
            "record",
            ["--verify", *DATA[:2], "--transitions", "10"],
            r"no hashes of 10 transitions of \S+ noisy were published",
        ),
        ("record", ["--verify", "--transitions", "5"], "numbers 1000, 100000, 1000000"),
        (
            "record",
            ["--verify", "--seed", "1", "--out", "x.pt"],
            "verify does not work with out, seed",
        ),
        ("record", [*DATA, "--episodes", "3"], "do not work with the kind noisy"),
        ("record", [*DATA, "--noise-eps", "0.1"], "episodes and noise_eps do not work"),
        ("record", DATA[:2], "needs a file or name to write"),
        ("record", ["--transitions", "9"], "transitions and play_noise do not work"),
        ("record", [*DATA, "--env-id", "KukaReach-v1"], "no expert for"),
        (
            "record",
            ["--format", "minari", "--seed", str(2**63 - 1)],
            r"must be below 2\*\*63",
        ),
        (
            "record",
            ["--format", "minari", "--task-options", "distance_threshold", "0.5"],
            "task_options do not work with the format minari",
        ),
        ("bench", ["--ids", "PandaFly-v1"], "unknown environment id 'PandaFly-v1'"),
        ("bench", ["--num-envs", "4", "0"], "num_envs must be positive, got "),
        ("bench", ["--plot", "/dev/null/speed.png"], "File exists"),
        ("bench", ["--others", "slow"], "others must be some of torch_panda, fast, .*"),
        ("bench", ["--plot", "a.xyz"], "plot must end in one of .*, got 'a.xyz'"),
        ("plot", ["nowhere"], "there is no run below nowhere: a run is"),
        ("trian", [], r"unknown command 'trian'(.|\n)*evaluate"),
    ],
)
def test_wrong_options_are_refused(tmp_path, monkeypatch, command, options, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=message) as stop:
        main([command, *options])
    assert command == "trian" or "\n" not in str(stop.value)
    assert list(tmp_path.iterdir()) == []
