"""Convert a recording for training: robomimic, diffusion policy (zarr), or plain .npz files.

hal export data/demo --to robomimic
hal export data/demo --to zarr --resize 96x96 --successful-only
hal export data/demo --to npz --episodes 0,3-5
"""

from __future__ import annotations

import argparse
import re
import sys

from hal.apps._common import program, split_names
from hal.apps._display import count_episodes, show_episodes
from hal.errors import CommandError


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal export",
        description="Convert a recording for training. The recording is only read; LeRobot trains on it directly.",
        epilog="The output appears only when it is complete. The exit status is then 0, else 2.",
    )
    made.add_argument("dataset", metavar="DATASET", help="the folder of a recording")
    made.add_argument(
        "--to",
        dest="kind",
        required=True,
        choices=("robomimic", "zarr", "npz"),
        help="robomimic: one HDF5 file; zarr: as diffusion policy's replay buffer; npz: one .npz per episode; LeRobot "
        "reads the dataset as it is",
    )
    made.add_argument("--out", metavar="PATH", help="output (default: beside the dataset)")
    made.add_argument("--force", action="store_true", help="overwrite if it exists")
    what = made.add_argument_group("selection")
    what.add_argument("--episodes", metavar="0,3-5", help="episodes to export (default: all)")
    what.add_argument("--successful-only", action="store_true", help="only episodes marked as a success")
    what.add_argument("--cameras", metavar="A,B", help="cameras to export, or none (default: all)")
    what.add_argument("--no-depth", dest="depth", action="store_false", help="do not export depth")
    what.add_argument(
        "--resize", metavar="WxH", help="crop images to this aspect ratio around the center, and scale them"
    )
    what.add_argument(
        "--action",
        default="joint_position",
        choices=("joint_position", "joint_velocity", "tcp_pose", "tcp_delta"),
        help="joint targets, joint velocities, or poses or steps of the tcp in the base frame (%(default)s)",
    )
    what.add_argument(
        "--rotation",
        choices=("quaternion", "axis_angle", "rotation_6d"),
        help="rotation of tcp_pose and tcp_delta (quaternion)",
    )
    names = made.add_argument_group("for --to npz")
    names.add_argument("--camera", metavar="NAME", help="camera exported as camera (default: the first fixed one)")
    names.add_argument(
        "--gripper-camera", metavar="NAME", help="camera exported as gripper_camera (default: the first on an arm)"
    )
    split = made.add_argument_group("for --to robomimic")
    split.add_argument(
        "--valid", type=float, default=0.1, metavar="SHARE", help="share of episodes for validation (%(default)s)"
    )
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from hal.recording.exporters import export

    made = export(
        args.dataset,
        args.kind,
        args.out,
        episodes=args.episodes,
        successful_only=args.successful_only,
        cameras=split_names(args.cameras),
        depth=args.depth,
        size=_size(args.resize),
        camera=args.camera,
        gripper_camera=args.gripper_camera,
        valid=args.valid,
        action=args.action,
        rotation=args.rotation,
        force=args.force,
        on_episode=show_episodes(sys.stderr),
    )
    for note in made.notes:
        print(f"note: {note}")
    print(f"wrote {made.path}: {count_episodes(made.episodes)}, {made.rows} rows, {made.size / 1e6:.1f} MB")
    return 0


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None:
        raise CommandError(f"--resize takes a width and a height, such as 96x96, not {text!r}")
    return int(match[1]), int(match[2])


if __name__ == "__main__":
    sys.exit(main())
