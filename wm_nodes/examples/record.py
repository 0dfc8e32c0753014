"""Record a policy in its real environment through the graph; then `wm train-model --bags BAG`.

One of your own, or one that `wm train-policy` has cloned or trained, by its weights and the model whose tokenizer it
sees by; with its exploration noise, or --deterministic:

python -m examples.record /tmp/own_bag --environment.factory examples.own_environment:make
    --policy.factory wm_nodes.policy_rl.factories:untrained_policy --steps 40
python -m examples.record /tmp/clone_bag --environment.factory examples.own_environment:make
    --model-dir MODEL --initial-policy RUN/policies/weak.safetensors --steps 40
"""
import argparse
import json
import os
import sys
from pathlib import Path

from wm_nodes.apps.cli import EXPECTED
from wm_nodes.config.load import split_settings
from wm_nodes.launching import arguments
from wm_nodes.launching.graph_client import GraphClient
from wm_nodes.launching.runner import Runner


def main(words: list[str] | None = None) -> int:
    options, settings = split_settings(sys.argv[1:] if words is None else words)
    parser = argparse.ArgumentParser()
    parser.add_argument("bag", type=Path, help="folder of the recording; what the nodes say lies in <bag>_run")
    for name, default in (("preset", "cpu"), ("task", ""), ("model-dir", ""), ("initial-policy", ""), ("steps", 100),
                          ("num-envs", 8), ("seed", 0), ("domain-id", "")):
        parser.add_argument(f"--{name}", default=default, type=type(default))
    parser.add_argument("--deterministic", action="store_true", help="act without exploration noise")
    given = parser.parse_args(options)
    run_dir = given.bag.with_name(f"{given.bag.name}_run")
    graph, _ = arguments.prepare("rollout_record", {
        "backend": "environment", "task": given.task, "preset": given.preset, "num_envs": str(given.num_envs),
        "model_dir": given.model_dir, "initial_policy": given.initial_policy, "seed": str(given.seed),
        "domain_id": given.domain_id, "bag_uri": str(given.bag), "run_dir": str(run_dir),
        **{name: json.dumps(value) for name, value in settings.items()},
    })
    with Runner(graph, log=None, log_dir=run_dir / "logs") as runner:
        runner.wait_ready()
        os.environ.update(runner.environment)
        with GraphClient(alive=runner.check) as client:
            made = client.rollout(given.steps, seed=given.seed, deterministic=given.deterministic)
    print(f"{given.bag}: {made.episodes} episodes, {made.successes} succeed")
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except EXPECTED as error:
        raise SystemExit(f"error: {error}") from None
