"""Grasps in recordings of earlier versions: there the gripper's number is the object's width, and not a closed hand.

Those versions recorded ``gripper.grasp(width)``, and the grasps of skills, as a motion to that width, without a force;
driven again, the fingers touch the object and do not press. A motion that was meant to end at a width looks the same,
so a grasp is repaired only where it can be proven.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..geometry import Pose
from .changing import EpisodeChange, change_episodes
from .dataset import Episode, lacks_grip_force
from .layout import ACTION, SETPOINT, SOURCE, SOURCES, STATE, DatasetLayout, current_key

_ARRIVED = 0.001
"""Difference from a target width at which fingers still count as arrived, m."""
_STILL = 0.0005
"""Change of the width from row to row below which the fingers rest, m."""
_CARRIED, _SLIPPED = 0.02, 0.005
"""Way of an object that counts as carried, and motion relative to the hand meanwhile, m."""
_OBJECT = "rig.object."


class Closing(NamedTuple):
    """Rows in which the fingers of one gripper are asked for one width, and have closed to it or beyond."""

    gripper: int
    """Index of its number in ``rig.setpoint``."""
    first: int
    end: int
    """Row after the last one."""
    width: float
    """The width in the gripper's column, m."""
    proof: str
    """Why this was a grasp; empty if it may have been a motion to that width."""


def find_closings(episode: Episode) -> Iterator[Closing]:
    """Yield where the fingers closed to a width: what an earlier version may have recorded of a grasp.

    It was one if the fingers went on beyond the width, or if they carried an object. Rows that a person or a policy
    drove are left out: what they ask of a gripper was always recorded as it was.
    """
    columns, names = episode.columns, episode.names(SETPOINT)
    rows = episode.length
    targets, widths = (columns[key].reshape(rows, -1).astype(np.float64) for key in (SETPOINT, STATE))
    source = columns.get(SOURCE, np.zeros(rows, np.int64))
    scripted = ~np.isin(source, [SOURCES.index("person"), SOURCES.index("policy")])
    for k in (k for k, name in enumerate(names) if name.split(".")[-1] == "gripper"):
        lead = names[k].removesuffix("gripper")
        edges = np.flatnonzero(np.abs(np.diff(targets[:, k])) > 1e-6) + 1
        for first, end in zip([0, *edges], [*edges, rows], strict=True):
            target, width = targets[first, k], widths[first:end, k]
            resting = np.flatnonzero(np.abs(np.diff(width, prepend=np.inf)) < _STILL) + first
            closes = 0.0 < target < width[0] - _ARRIVED and scripted[first:end].all()
            if closes and len(resting) and widths[resting, k].min() < target + _ARRIVED:
                last = resting[widths[resting, k] < target + _ARRIVED]
                beyond = bool((widths[last, k] < target - _ARRIVED).any())
                carried = _carried_object(episode, lead, int(last[0]), int(end))
                proof = "the fingers closed beyond it" if beyond else f"{carried} was carried" if carried else ""
                yield Closing(k, int(first), int(end), float(target), proof)


def _carried_object(episode: Episode, lead: str, first: int, end: int) -> str:
    """Return the name of an object that moved with a tcp between two rows; empty if there is none.

    ``lead`` is what names of the arm's numbers begin with: empty for the only arm, else ``left.``.
    """
    columns = episode.columns
    place = episode.names("observation.tcp").index(f"{lead}x")
    tcp = columns["observation.tcp"][first:end, place : place + 7].astype(np.float64)
    base = next(
        (
            Pose(robot["base_position"], robot["base_orientation"])
            for robot in episode.info["rig"]["resolved"].get("robots", ())
            if lead in ("", f"{robot['name']}.")
        ),
        Pose(),
    )
    for key in (key for key in columns if key.startswith(_OBJECT)):
        poses = columns[key][first:end].astype(np.float64)
        if len(poses) < 2 or not (np.isfinite(poses).all() and np.isfinite(tcp).all()):
            continue
        way = np.linalg.norm(poses[:, :3] - poses[0, :3], axis=1)
        moved = np.flatnonzero(way >= _CARRIED)
        if len(moved) and _slips(base, tcp[: moved[0] + 1], poses[: moved[0] + 1]) <= _SLIPPED:
            return key.removeprefix(_OBJECT)
    return ""


def _slips(base: Pose, tcp: NDArray[np.float64], poses: NDArray[np.float64]) -> float:
    """Return how far an object moves in the frame of the tcp, m."""
    seen = []
    for hand, pose in zip(tcp, poses, strict=True):
        frame = base @ Pose(hand[:3], hand[3:] / np.linalg.norm(hand[3:]))
        seen.append((frame.inverse() @ Pose(pose[:3], pose[3:] / np.linalg.norm(pose[3:]))).position)
    return float(np.linalg.norm(np.array(seen) - seen[0], axis=1).max())


def repair_grasps(layout: DatasetLayout, episodes: Collection[Episode]) -> list[str]:
    """Record proven grasps of earlier versions as a closed hand: 0 in ``rig.setpoint`` and ``action``.

    ``grasps`` in ``episodes/N.json`` lists what was closed and what cannot be known. Episodes with it are left out.

    Args:
        layout: The dataset, which must be locked.
        episodes: Its episodes.

    Returns:
        What was done, and what cannot be known, in lines.

    Raises:
        DatasetError: A file that other episodes share is damaged; nothing was changed.
    """
    changes: dict[int, EpisodeChange] = {}
    closed, unknown = [], []
    for episode in episodes:
        if not lacks_grip_force(episode._meta["features"]) or "grasps" in episode.info:
            continue
        try:
            found = list(find_closings(episode))
        except DatasetError:  # a damaged episode stays as it is, and is reported by the check
            continue
        proven = [closing for closing in found if closing.proof]
        rest = [closing for closing in found if not closing.proof]
        closed += [(episode.number, closing) for closing in proven]
        unknown += [(episode.number, closing) for closing in rest]
        about = {"closed": list(map(_as_json, proven)), "unknown": list(map(_as_json, rest))}
        changes[episode.number] = EpisodeChange({"grasps": about}, _closed_columns(episode, proven) if proven else {})
    change_episodes(layout, changes)
    lines = [f"{_many(closed)}, recorded as the width of the object, became a closed hand"] if closed else []
    if unknown:
        lines.append(
            f"{_many(unknown)} may be a grasp or a motion to that width, which the recording does not tell; left as "
            "recorded"
        )
    if closed or unknown:
        lines.append("the forces of grasps were not recorded: a replay presses with the gripper's own")
    return lines


def _closed_columns(episode: Episode, proven: list[Closing]) -> dict[str, NDArray[Any]]:
    """Return the columns of the gripper with 0 in the rows of grasps; the action is one row ahead."""
    stored = {current_key(key): key for key in episode._meta["features"]}
    setpoint, action = (episode.columns[key].reshape(episode.length, -1).copy() for key in (SETPOINT, ACTION))
    for k, first, end, width, _ in proven:
        setpoint[first:end, k] = 0.0
        ahead = action[max(0, first - 1) : end, k]
        ahead[np.abs(ahead - width) < 1e-6] = 0.0
    return {stored[SETPOINT]: setpoint, stored[ACTION]: action}


def _as_json(closing: Closing) -> dict[str, Any]:
    rows = {"first": closing.first, "rows": closing.end - closing.first}
    return {"gripper": closing.gripper, **rows, "width": round(closing.width, 6), "proof": closing.proof}


def _many(closings: list[tuple[int, Closing]]) -> str:
    """Return how many closings there are, and in which episodes, ten at most."""
    numbers = list(dict.fromkeys(number for number, _ in closings))
    listed = ", ".join(map(str, numbers[:10])) + (" ..." if len(numbers) > 10 else "")
    count = f"{len(closings)} closing{'' if len(closings) == 1 else 's'} of a gripper"
    return f"{count} in episode{'' if len(numbers) == 1 else 's'} {listed}"
