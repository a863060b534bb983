"""The page of ``hal review``: episodes of a dataset in a browser, to rank, look at, replay in 3D, mark and delete.

The server listens on this computer only. What it shows and changes needs the token of its link, in a header that no
other site can make a browser send; a replay, which changes nothing, in its path.
"""

from __future__ import annotations

import math
import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from html import escape
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import registry
from ..auth import Authenticator, page_link
from ..config.data_files import FOLDERS, find_data
from ..errors import CommandError, DatasetError, HalError
from ..geometry import Pose
from ..specs import BodySpec, RobotSpec, WorldSpec, from_json
from ..views import ReplayFrame
from .changing import mark_episodes
from .dataset import Dataset, Episode
from .exporters.content import EpisodeContent
from .layout import STATE
from .merging import delete_episodes
from .review import EpisodeSummary, draw_sheet, measure_episode

_ADDRESS = "127.0.0.1"
_MARKS = {"success": True, "failure": False, "none": None}
_ORDERS: dict[str, Callable[[EpisodeSummary], float]] = {
    "episode": lambda line: line.number,
    "seconds": lambda line: -line.seconds,
    "mark": lambda line: {False: 0, None: 1, True: 2}[line.success],
    "stops": lambda line: -line.trips,
    "dropped": lambda line: -line.dropped,
    "jerk, rad/s\N{SUPERSCRIPT THREE}": lambda line: math.inf if math.isnan(line.jerk) else -line.jerk,
    "idle": lambda line: -line.idle,
}
"""Heading of a column -> its key for sorting: what needs a look comes first."""
_HTML = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Review</title>
<meta name="viewport" content="width=device-width"><link rel="stylesheet" href="/style.css">
<script src="/page.js" defer></script></head>
<body><p id="note" role="status">Loading...</p><div id="list"></div><div id="sheet"></div>
<iframe id="replay" title="The episode in 3D"></iframe></body></html>"""
_STYLE = """
body { padding: 12px; }
#note { min-height: 24px; color: var(--quiet); }
#list, #sheet { overflow-x: auto; background: var(--panel); border: 1px solid var(--line); padding: 8px; }
#sheet { margin-top: 12px; }
#sheet:empty, #replay:not([src]) { display: none; }
#replay { width: 100%; height: 70vh; min-height: 400px; margin-top: 12px; border: 1px solid var(--line); }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: 2px 10px 2px 0; white-space: nowrap; border-bottom: 1px solid var(--line); }
tr[data-shown] { background: var(--tint); }
svg { width: 100%; min-width: 800px; height: auto; display: block; margin-top: 8px; }
.bar { display: flex; flex-wrap: wrap; gap: 8px; align-items: center; }
"""
_SCRIPT = """const at = (id) => document.getElementById(id), token = location.hash.slice(1);
let order = 0, shown = null;
async function call(path, method = "GET") {
  const answer = await fetch(path, { method, headers: { Authorization: `Bearer ${token}` } });
  const text = await answer.text();
  if (!answer.ok) throw new Error(text);
  return text;
}
async function paint() {
  at("list").innerHTML = await call(`/episodes/${order}`);
  at("note").textContent = at("list").firstElementChild.dataset.about;
  at("sheet").innerHTML = shown === null ? "" : await call(`/sheet/${shown}`);
  for (const row of document.querySelectorAll(`[data-row="${shown}"]`)) row.dataset.shown = "";
}
document.addEventListener("click", async ({ target }) => {
  const { order: by, show, post, ask, replay } = target.dataset;
  if (ask && !confirm(ask)) return;
  try {
    if (by) order = by;
    if (show) shown = show;
    if (post) await call(post, "POST");
    if (ask) shown = null;
    if (show || ask) at("replay").removeAttribute("src");
    if (by || show || post) await paint();
    if (replay) {
      at("replay").src = `/replay/${token}/${replay}`;
      at("replay").scrollIntoView();
    }
  } catch (error) {
    at("note").textContent = error.message;
  }
});
paint().catch((error) => { at("note").textContent = error.message; });
"""
_HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; connect-src 'self'; frame-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_REPLAY_POLICY = (
    "default-src blob: data: 'unsafe-inline' 'unsafe-eval'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
"""Of the replay: one file, which compiles what it brings, and loads nothing."""
_EMPTY = WorldSpec("", 0.0, (0.0, 0.0, 0.0), (BodySpec("floor", (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), "plane"),), ())
"""What is shown around real arms."""
_REPLAY_HZ = 50
"""About the greatest rate of a replay's frames."""


class ReviewServer(HTTPServer):
    """Serves the page of one dataset, a request at a time.

    Args:
        dataset: Folder of the dataset.
        port: Port on the loopback interface; 0 for a free one.
        style: Style sheet of colours and buttons.

    Raises:
        CommandError: The port is taken (code ``port_taken``).
    """

    def __init__(self, dataset: str | Path, port: int, style: bytes) -> None:
        self._root = Path(dataset)
        self._dataset: Dataset | None = None
        self._read: dict[int, tuple[object, EpisodeSummary]] = {}
        """Of each episode the versions of its files, and what they hold."""
        token = secrets.token_urlsafe(18)
        self.auth = Authenticator(token, _ADDRESS, ())
        self.files = {
            "/": (_HTML.encode(), "text/html"),
            "/page.js": (_SCRIPT.encode(), "text/javascript"),
            "/style.css": (style + _STYLE.encode(), "text/css"),
        }
        try:
            super().__init__((_ADDRESS, port), _Handler)
        except (OSError, OverflowError) as error:
            raise CommandError(f"the page cannot be served on port {port}: {error}", code="port_taken") from None
        self.link = page_link(_ADDRESS, self.server_port, token)

    def read_dataset(self) -> Dataset:
        """Return the dataset as it is now."""
        if self._dataset is None or self._dataset.has_changed():
            self._dataset = Dataset(self._root)
        return self._dataset

    def measure_episode(self, episode: Episode) -> EpisodeSummary:
        """Return the numbers of an episode; its files are read once, until they change. Raises DatasetError."""
        versions, known = episode.file_versions(), self._read.get(episode.number)
        if known is None or known[0] != versions:
            known = self._read[episode.number] = versions, measure_episode(episode)
        return known[1]

    def mark_episode(self, dataset: Dataset, number: int, mark: bool | None) -> None:
        """Mark an episode; see :func:`mark_episodes`."""
        known = self._known_lines(dataset)
        mark_episodes(dataset, {number: mark})
        self._keep(replace(line, success=mark) if line.number == number else line for line in known)

    def delete_episode(self, dataset: Dataset, number: int) -> None:
        """Delete an episode; see :func:`delete_episodes`."""
        known = self._known_lines(dataset)
        delete_episodes(dataset, [number])
        left = (line for line in known if line.number != number)
        self._keep(replace(line, number=line.number - (line.number > number)) for line in left)

    def _known_lines(self, dataset: Dataset) -> list[EpisodeSummary]:
        """Return the numbers of the episodes whose files have not changed since they were read."""
        read = ((dataset.episodes[number], *known) for number, known in self._read.items() if number < len(dataset))
        return [line for episode, versions, line in read if episode.file_versions() == versions]

    def _keep(self, lines: Iterable[EpisodeSummary]) -> None:
        """Keep what is known, though files that episodes share have just been written anew."""
        episodes = self.read_dataset().episodes
        self._read = {line.number: (episodes[line.number].file_versions(), line) for line in lines}


class _Handler(BaseHTTPRequestHandler):
    server: ReviewServer
    timeout = 10
    """Longest wait for a request, s."""

    def do_GET(self) -> None:
        self._answer("GET")

    def do_POST(self) -> None:
        self._answer("POST")

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    def _answer(self, method: str) -> None:
        auth, host, path = self.server.auth, self.headers.get("Host"), self.path.split("/")[1:]
        offered = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if method == "GET" and len(path) == 3 and path[0] == "replay":  # a frame, which sends no headers
            offered = path.pop(1)
        if not auth.is_known_host(host):
            self._send(421, "this server has another name; open the link that it printed")
        elif method == "GET" and self.path in self.server.files:
            body, kind = self.server.files[self.path]
            self._send(200, body, kind)
        elif not auth.is_token(offered):
            self._send(403, "this link is not valid: use the newest link in the terminal")
        elif method == "POST" and not auth.is_own_origin(self.headers.get("Origin"), host):
            self._send(403, "this page was not served by this server")
        else:
            try:
                answer = self._act(method, path)
                if path[0] == "replay":
                    self._send(200, answer, "text/html", _REPLAY_POLICY)
                else:
                    self._send(200, answer)
            except (HalError, OSError) as error:
                self._send(409, str(error))
            except (LookupError, ValueError):
                self._send(404, "there is no such page")

    def _send(self, status: int, body: str | bytes, kind: str = "text/plain", policy: str = _POLICY) -> None:
        data = body.encode() if isinstance(body, str) else body
        self.send_response(status)
        for name, value in (_HEADERS | {"Content-Security-Policy": policy}).items():
            self.send_header(name, value)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def _act(self, method: str, path: list[str]) -> str:
        """Return the HTML at a path, or change the dataset. LookupError or ValueError for an unknown path."""
        dataset = self.server.read_dataset()
        if method == "GET" and path[0] == "episodes":
            return "\n".join(_write_list(self.server, dataset, list(_ORDERS)[int(path[1])]))
        number = int(path[1])
        if method == "GET" and path[0] == "replay":
            return write_replay(dataset.episodes[number])
        if method == "GET" and path[0] == "sheet":
            return f"{_write_buttons(dataset, number)}{draw_sheet(dataset.episodes[number])}"
        if method == "POST" and int(path[2]) != len(dataset):
            raise CommandError("the dataset has changed since this page showed it: reload the page")
        if method == "POST" and path[0] == "mark":
            self.server.mark_episode(dataset, number, _MARKS[path[3]])
        elif method == "POST" and path[0] == "delete":
            self.server.delete_episode(dataset, number)
        else:
            raise LookupError
        return "done"


def write_replay(episode: Episode) -> str:
    """Return a page that replays an episode in 3D.

    Raises:
        CommandError: The episode does not describe its arms (code ``no_replay``).
        HalError: The 3D view is not installed, an arm cannot be drawn, or the episode cannot be read.
    """
    content, resolved = EpisodeContent(episode), episode.info["rig"]["resolved"]
    arms = {arm.name for arm in content.arms}
    write = registry.load(registry.provider("replay3d"), "replay3d")
    try:
        robots = [from_json(RobotSpec, _find_urdf(each)) for each in resolved["robots"] if each["name"] in arms]
        world = _EMPTY
        if found := resolved["world"]:
            parts = {key: [_find_urdf(each) for each in found[key]] for key in ("bodies", "robots")}
            world = from_json(WorldSpec, found | parts)
        if robots:
            page: str = write(robots, world, _frames(content, robots))
            return page
        reason = "its rig is unknown"
    except HalError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        reason = f"its rig is described otherwise: {error}"
    raise CommandError(f"episode {episode.number} cannot be shown in 3D: {reason}", code="no_replay")


def _find_urdf(record: dict[str, Any]) -> dict[str, Any]:
    """Return the record of an arm or an object, without a workspace, and with the place of a built-in URDF here."""
    urdf = record["urdf"]
    if urdf is not None and not Path(urdf).is_file():
        parts = Path(urdf).parts
        for folder in set(FOLDERS).intersection(parts):
            with suppress(FileNotFoundError):
                urdf = str(find_data(folder, *parts[len(parts) - parts[::-1].index(folder) :]))
    return record | {"urdf": urdf, "workspace": None}


def _frames(content: EpisodeContent, robots: Sequence[RobotSpec]) -> Iterator[ReplayFrame]:
    arms = {arm.name: arm for arm in content.arms}
    joints = {name: _fill_gaps(content.of(arm, STATE)) for name, arm in arms.items()}
    widths = {name: content.width(arm) for name, arm in arms.items()}
    poses = {name: _fill_gaps(content.of(arm, "rig.tcp_set")) for name, arm in arms.items()}
    start = content.episode.info.get("objects_at_start") or {}
    objects = {name: _fill_gaps(values) for name, values in content.objects.items()}
    rows = range(0, content.rows, max(1, content.episode.fps // _REPLAY_HZ))
    waits = np.diff(content.grid[rows], prepend=0.0)
    for k, wait in zip(rows, waits.tolist(), strict=True):
        yield ReplayFrame(
            wait,
            {
                robot.name: robot.joint_positions(joints[robot.name][k].tolist(), _at(widths[robot.name], k))
                for robot in robots
            },
            {name: Pose(values[k, :3], values[k, 3:]) for name, values in poses.items()},
            start | {name: values[k].tolist() for name, values in objects.items()},
        )


def _at(width: NDArray[np.float32] | None, row: int) -> float | None:
    return None if width is None or not math.isfinite(width[row]) else float(width[row])


def _fill_gaps(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return rows (n, m) in which unknown ones have the last known values, or else the first."""
    known = np.isfinite(values).all(axis=1)
    rows = np.maximum.accumulate(np.where(known, np.arange(len(values)), np.argmax(known)))
    return np.nan_to_num(values.astype(np.float64))[rows]


def _write_list(server: ReviewServer, dataset: Dataset, order: str) -> Iterator[str]:
    """Yield the table of all episodes as HTML, in an order."""
    lines, broken = list[EpisodeSummary](), list[str]()
    for episode in dataset.episodes:
        try:
            lines.append(server.measure_episode(episode))
        except DatasetError as error:
            broken.append(str(error))
    marks, seconds = Counter(line.success for line in lines), sum(line.seconds for line in lines)
    rows, robot = sum(line.rows for line in lines), dataset.info.get("robot_type")
    about = f"{dataset.root}: {robot}, {rows} rows at {dataset.fps} Hz, {seconds:.1f} s; "
    about += f"{marks[True]} succeeded, {marks[False]} failed, {marks[None]} not marked"
    yield f'<table data-about="{escape(about)}"><tr>'
    for k, name in enumerate(_ORDERS):
        yield f'<th><button data-order="{k}" aria-pressed="{str(name == order).lower()}">{name}</button></th>'
    yield "<th>task</th></tr>"
    for line in sorted(lines, key=_ORDERS[order]):
        mark = {True: "success", False: "failure", None: "-"}[line.success]
        cells = [f"{line.seconds:.1f}", mark, line.trips, line.dropped, f"{line.jerk:.1f}", f"{100 * line.idle:.0f} %"]
        task = line.task + (f" [{line.trouble}]" if line.trouble else "")
        yield f'<tr data-row="{line.number}"><td><button data-show="{line.number}">Show {line.number}</button></td>'
        yield "".join(f"<td>{escape(str(cell))}</td>" for cell in (*cells, task)) + "</tr>"
    yield "</table>"
    yield from (f"<p>cannot be read: {escape(line)}</p>" for line in broken)


def _write_buttons(dataset: Dataset, number: int) -> str:
    count, success = len(dataset), dataset.episodes[number].success
    marks = "".join(
        f'<button data-post="/mark/{number}/{count}/{name}" {"data-pressed" * (mark is success)}>{label}</button>'
        for (name, mark), label in zip(_MARKS.items(), ("Success", "Failure", "No mark"), strict=True)
    )
    ask = f"Delete episode {number}? This cannot be undone; later episodes get lower numbers."
    delete = f'<button data-post="/delete/{number}/{count}" data-ask="{ask}">Delete</button>'
    replay = f'<button data-replay="{number}">Replay in 3D</button>'
    return f'<div class="bar"><h2>Episode {number}</h2>{replay}{marks}{delete}</div>'
