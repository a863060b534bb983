"""Serve a policy that was trained with LeRobot on a recording of this package. Runs in LeRobot's own environment.

hal-serve-lerobot runs/demo/checkpoints/last/pretrained_model --port 8000
hal-rollout --policy ws://127.0.0.1:8000 --sim

LeRobot's environment needs this package without its dependencies, and two small ones:
pip install --no-deps robot-hal && pip install aiohttp msgpack
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import threading
from collections.abc import Collection, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from hal.apps._common import run_app
from hal.errors import CommandError, DriverMissing

STATE, IMAGES, ACTION = "observation.state", "observation.images.", "action"
GRIPPER = "gripper"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="serve-lerobot",
        description="Serve a policy that was trained with LeRobot on a recording of this package, for hal-rollout.",
        epilog="It runs in LeRobot's environment. There is no password: listen on other addresses only in a network "
        "that you trust.",
    )
    made.add_argument("checkpoint", metavar="CHECKPOINT", help="folder with config.json and model.safetensors")
    made.add_argument(
        "--dataset", metavar="DIR", help="the recording that it was trained on (default: as the checkpoint names it)"
    )
    made.add_argument("--device", default="auto", help="torch device (default: cuda if there is one)")
    made.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen at (%(default)s)")
    made.add_argument("--port", type=int, default=8000, help="port; 0 for a free one (%(default)s)")
    made.add_argument("--until-stdin-ends", action="store_true", help="end when standard input is closed")
    return made


def main(argv: list[str] | None = None) -> int:
    """Run the program; return the exit status."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    from hal.learning.remote import PolicyServer

    if args.until_stdin_ends:
        threading.Thread(target=_end_with_stdin, daemon=True).start()
    checkpoint = Path(args.checkpoint).expanduser()
    if not (checkpoint / "config.json").is_file():
        raise CommandError(f"{checkpoint} has no config.json: pass the folder pretrained_model of a checkpoint")
    info = _dataset_info(checkpoint, args.dataset)
    policy = LeRobotPolicy(checkpoint, args.device)
    metadata = describe(info, policy.inputs)
    with PolicyServer(policy.infer, reset=policy.reset, metadata=metadata, host=args.host, port=args.port) as server:
        print(f"{policy.kind} for {', '.join(metadata['joints'])} at {metadata['policy_config']['rate_hz']} Hz")
        print(f"listening at {server.url}", flush=True)
        server.wait()
    return 0


def _end_with_stdin() -> None:
    """End this process when standard input is closed, also while it loads a policy or computes."""
    with contextlib.suppress(OSError):
        sys.stdin.buffer.read()
    os._exit(0)


def _dataset_info(checkpoint: Path, dataset: str | None) -> dict[str, Any]:
    """Return ``meta/info.json`` of the recording that a checkpoint was trained on."""
    if dataset is None:
        train = checkpoint / "train_config.json"
        found = json.loads(train.read_text()).get("dataset", {}).get("root") if train.is_file() else None
        if not found:
            raise CommandError("the checkpoint does not name its dataset; pass --dataset DIR")
        dataset = str(found)
    path = Path(dataset).expanduser() / "meta" / "info.json"
    if not path.is_file():
        raise CommandError(f"there is no {path}; pass --dataset DIR, a recording of this package")
    info: dict[str, Any] = json.loads(path.read_text())
    return info


def describe(info: Mapping[str, Any], inputs: Collection[str]) -> dict[str, Any]:
    """Return what a client needs to know: the joints, and a policy configuration.

    Args:
        info: ``meta/info.json`` of the recording.
        inputs: Names of the features that the policy uses.

    Raises:
        CommandError: The policy uses other columns than the state and the pictures (code ``unknown_input``), or the
            recording is of another program or of several arms (``foreign_dataset``).
    """
    features = info["features"]
    names = list(features[ACTION]["names"] or [])
    joints = [name for name in names if name != GRIPPER]
    if features.get(STATE, {}).get("names") != names or names not in (joints, [*joints, GRIPPER]):
        raise CommandError(f"{STATE} and {ACTION} of the dataset are not joints and a gripper", code="foreign_dataset")
    observation: dict[str, Any] = {"task": {"text": "task"}}
    for key in inputs:
        if key == STATE:
            observation[key] = {"state": ["q", "width"] if GRIPPER in names else ["q"]}
        elif key.startswith(IMAGES):
            observation[key] = {"camera": key.removeprefix(IMAGES), "size": features[key]["shape"][:2]}
        else:
            raise CommandError(f"the policy uses {key}, which is not served", code="unknown_input")
    # The action of a row is the set-point one row later.
    action: dict[str, Any] = {"kind": "joint_position", "first": 1}
    if GRIPPER in names:
        action["gripper"] = {"index": len(joints), "metres": True}
    config = {"rate_hz": info["fps"], "observation": observation, "action": action}
    return {"joints": joints, "robot_type": info.get("robot_type"), "policy_config": config}


class LeRobotPolicy:
    """A checkpoint of LeRobot, with its own processing before and after the network."""

    def __init__(self, checkpoint: Path, device: str) -> None:
        """Load a checkpoint; raises DriverMissing without LeRobot."""
        os.environ.setdefault("HF_HUB_OFFLINE", "1")
        try:
            torch: Any = import_module("torch")
            factory: Any = import_module("lerobot.policies.factory")
            configs: Any = import_module("lerobot.configs.policies")
        except ImportError as error:
            raise DriverMissing(
                f"this program runs in an environment with LeRobot: {error}", name=error.name
            ) from error
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        config = configs.PreTrainedConfig.from_pretrained(checkpoint)
        config.device = device
        self.kind: str = config.type
        pictures = list(config.image_features)
        self.inputs = [*([STATE] if config.robot_state_feature is not None else []), *pictures]
        self._torch, self._device = torch, device
        self._policy = factory.get_policy_class(config.type).from_pretrained(checkpoint, config=config)
        self._policy.eval()
        override = {"device_processor": {"device": device}}
        self._before, self._after = factory.make_pre_post_processors(
            config, pretrained_path=str(checkpoint), preprocessor_overrides=override, postprocessor_overrides=override
        )

    def reset(self, request: Mapping[str, Any]) -> None:
        """Begin an episode."""
        self._policy.reset()

    def infer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return a chunk of actions (steps, numbers) for the observation of a request."""
        torch = self._torch
        batch: dict[str, Any] = {"task": [str(request.get("task", ""))]}
        for key in self.inputs:
            values = torch.from_numpy(np.array(request[key]))
            if key.startswith(IMAGES):
                values = values.permute(2, 0, 1).to(torch.float32) / 255.0
            batch[key] = values[None].to(self._device)
        with torch.inference_mode():
            chunk = self._policy.predict_action_chunk(self._before(batch))
            actions = torch.stack([self._after(chunk[:, k]) for k in range(chunk.shape[1])], dim=1)
        return {"actions": actions[0].to("cpu", torch.float32).numpy()}


if __name__ == "__main__":
    sys.exit(main())
