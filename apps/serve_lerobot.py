"""Serve a policy that was trained with LeRobot on a recording of this package. Runs in LeRobot's own environment.

hal serve-lerobot runs/demo/checkpoints/last/pretrained_model --port 8000
hal rollout --policy ws://127.0.0.1:8000 --sim

LeRobot's environment needs this package without its dependencies, and two small ones:
pip install --no-deps robot-hal && pip install aiohttp msgpack
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Collection, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hal.apps._common import program
from hal.errors import CommandError, DriverMissing

if TYPE_CHECKING:
    from hal.host.process import Channel
    from hal.learning.remote import PolicyServer

STATE, IMAGES, ACTION = "observation.state", "observation.images.", "action"
ENVIRONMENT = "observation.environment_state"
GRIPPER = "gripper"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal serve-lerobot",
        description="Serve a policy that was trained with LeRobot on a recording of this package, for hal rollout.",
        epilog="It runs in LeRobot's environment.",
    )
    made.add_argument("checkpoint", metavar="CHECKPOINT", help="folder with config.json and model.safetensors")
    made.add_argument(
        "--dataset", metavar="DIR", help="the recording that it was trained on (default: as the checkpoint names it)"
    )
    made.add_argument("--device", default="auto", help="torch device (default: cuda if there is one)")
    made.add_argument(
        "--rtc",
        action="store_true",
        help="real-time chunking: each chunk continues the one before (pi0, pi05, SmolVLA)",
    )
    made.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to listen at (%(default)s); every other needs certificates: hal keys",
    )
    made.add_argument("--port", type=int, default=8000, help="port; 0 for a free one (%(default)s)")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    with _make_server(args) as server:
        print(f"listening at {server.url}", flush=True)
        server.wait()
    return 0


def serve_checkpoint(channel: Channel, memories: object, config: dict[str, Any]) -> None:
    """Serve a checkpoint in a child of ``hal rollout``, which gets the address, until that ends."""
    from hal.host.process import serve

    with _make_server(parser().parse_args([config["checkpoint"], "--port", "0"])) as server:
        channel.send({"ready": server.url})
        serve(channel, {})


def _make_server(args: argparse.Namespace) -> PolicyServer:
    """Return the server that the options describe, with its policy loaded."""
    from hal.keys import Credentials, needs_keys
    from hal.learning.remote import PolicyServer

    keys = Credentials("host") if needs_keys(args.host) else None
    checkpoint = Path(args.checkpoint).expanduser()
    if not (checkpoint / "config.json").is_file():
        raise CommandError(f"{checkpoint} has no config.json: pass the folder pretrained_model of a checkpoint")
    info = _dataset_info(checkpoint, args.dataset)
    policy = LeRobotPolicy(checkpoint, args.device, args.rtc)
    metadata = describe(info, policy.inputs)
    if policy.rtc_delay:
        metadata["rtc_max_delay_steps"] = policy.rtc_delay
    print(f"{policy.kind} for {', '.join(metadata['joints'])} at {metadata['policy_config']['rate_hz']} Hz")
    where: dict[str, Any] = {"host": args.host, "port": args.port, "credentials": keys}
    return PolicyServer(policy.infer, reset=policy.reset, metadata=metadata, **where)


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

    Raises:
        CommandError: The policy uses other columns than the state, the poses of objects and the pictures (code
            ``unknown_input``), or the recording is of another program (``foreign_dataset``).
    """
    features = info["features"]
    arms = _group_columns(features)
    state: list[str] = []
    actions: list[dict[str, Any]] = []
    first = 0
    for arm, columns in arms.items():
        # The action of a row is the set-point one row later.
        action: dict[str, Any] = {"kind": "joint_position", "first": 1}
        if arm:
            action |= {"robot": arm, "columns": [first, first + len(columns)]}
        lead = f"{arm}." if arm else ""
        state.append(f"{lead}q")
        if GRIPPER in columns:
            state.append(f"{lead}width")
            action["gripper"] = {"metres": True}
        actions.append(action)
        first += len(columns)
    observation = {"task": {"text": "task"}, **{key: _describe_input(key, features, state) for key in inputs}}
    config: dict[str, Any] = {"rate_hz": info["fps"], "observation": observation}
    config |= {"action": actions[0]} if "" in arms else {"arms": actions}
    joints = [name for name in features[ACTION]["names"] if name.rpartition(".")[2] != GRIPPER]
    return {"joints": joints, "robot_type": info.get("robot_type"), "policy_config": config}


def _group_columns(features: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the columns of the action by arm; the arm of a recording of one is ``""``. Raises CommandError."""
    names = list(features[ACTION]["names"] or [])
    arms: dict[str, list[str]] = {}
    for name in names:
        arm, _, column = name.rpartition(".")
        arms.setdefault(arm, []).append(column)
    grouped = [f"{arm}.{column}" if arm else column for arm, columns in arms.items() for column in columns]
    foreign = any(GRIPPER in columns[:-1] for columns in arms.values()) or ("" in arms and len(arms) > 1)
    if not names or foreign or features.get(STATE, {}).get("names") != names or grouped != names:
        raise CommandError(f"{STATE} and {ACTION} of the dataset are not joints and a gripper", code="foreign_dataset")
    return arms


def _describe_input(key: str, features: Mapping[str, Any], state: list[str]) -> dict[str, Any]:
    """Return the entry of a policy configuration for one of the policy's features. Raises CommandError."""
    if key == STATE:
        return {"state": state}
    if key == ENVIRONMENT and key in features:
        return {"objects": list(dict.fromkeys(name.rpartition(".")[0] for name in features[key]["names"]))}
    if key.startswith(IMAGES):
        return {"camera": key.removeprefix(IMAGES), "size": features[key]["shape"][:2]}
    raise CommandError(f"the policy uses {key}, which is not served", code="unknown_input")


class LeRobotPolicy:
    """A checkpoint of LeRobot, with its own processing before and after the network."""

    def __init__(self, checkpoint: Path, device: str, rtc: bool = False) -> None:
        """Load a checkpoint; ``rtc`` lets a chunk continue the one before.

        Raises:
            DriverMissing: LeRobot is not installed.
            CommandError: ``rtc``, and LeRobot does not have it for this policy (code ``no_rtc``).
        """
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
        numbers = {STATE: config.robot_state_feature, ENVIRONMENT: config.env_state_feature}
        self.inputs = [*(key for key, feature in numbers.items() if feature is not None), *pictures]
        self._torch, self._device = torch, device
        self._policy = factory.get_policy_class(config.type).from_pretrained(checkpoint, config=config)
        self._policy.eval()
        self.rtc_delay = self._start_rtc(config) if rtc else 0
        """Greatest number of actions that a chunk takes from the one before; 0 without real-time chunking."""
        override = {"device_processor": {"device": device}}
        self._before, self._after = factory.make_pre_post_processors(
            config, pretrained_path=str(checkpoint), preprocessor_overrides=override, postprocessor_overrides=override
        )

    def reset(self, request: Mapping[str, Any]) -> None:
        """Begin an episode."""
        self._policy.reset()

    def infer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return a chunk of actions (steps, numbers) for the observation of a request."""
        torch, given = self._torch, request.get("rtc") if self.rtc_delay else None
        batch: dict[str, Any] = {"task": [str(request.get("task", ""))]}
        for key in self.inputs:
            values = torch.from_numpy(np.array(request[key]))
            if key.startswith(IMAGES):
                values = values.permute(2, 0, 1).to(torch.float32) / 255.0
            batch[key] = values[None].to(self._device)
        if given is not None:  # normalised with the observation, as in training
            batch[ACTION] = torch.from_numpy(np.array(given["actions"], np.float32))[None].to(self._device)
        with torch.no_grad():
            batch, options = self._before(batch), {}
            if given is not None:
                options = {"inference_delay": int(given["delay_steps"]), "prev_chunk_left_over": batch.pop(ACTION)}
            chunk = self._policy.predict_action_chunk(batch, **options)
            actions = torch.stack([self._after(chunk[:, k]) for k in range(chunk.shape[1])], dim=1)
        return {"actions": actions[0].to("cpu", torch.float32).numpy()}

    def _start_rtc(self, config: Any) -> int:
        """Turn real-time chunking on; return the greatest number of actions to take from the chunk before."""
        if not hasattr(self._policy, "init_rtc_processor"):
            raise CommandError(f"LeRobot has no real-time chunking for the policy {config.type}", code="no_rtc")
        rtc = import_module("lerobot.policies.rtc.configuration_rtc").RTCConfig(enabled=True)
        trained = int(getattr(config, "rtc_training_max_delay", 0))
        if trained:
            rtc.mode = "trained"
        config.rtc_config = rtc
        self._policy.init_rtc_processor()
        return trained or int(config.chunk_size) // 2


if __name__ == "__main__":
    sys.exit(main())
