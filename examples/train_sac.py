"""Throttle and steering with SAC, on a highway that does not pay for spinning."""

import sys
from pathlib import Path

from esc_agents.config import EvaluationConfig, config_for_env
from esc_agents.training.train import train

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
run_dir = Path(sys.argv[2]) if len(sys.argv) > 2 else None

if __name__ == "__main__":  # training may start worker processes
    update = {"algo": "sac", "steps": steps, "run_dir": run_dir}
    update["evaluation"] = EvaluationConfig(episodes=3)  # few, so that the example ends soon
    config = config_for_env("highway-fast").model_copy(update=update)
    print("actions:", config.continuous.env_config["action"])
    train(config)
