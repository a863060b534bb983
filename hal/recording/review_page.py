"""The page of ``hal review``: episodes of a dataset in a browser, to rank, look at, mark and delete.

The server listens on this computer only. What it shows and changes needs the token of its link, in a header that no
other site can make a browser send.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable, Iterator
from html import escape
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

from ..auth import Authenticator, page_link
from ..errors import CommandError, DatasetError
from .changing import mark_episodes
from .dataset import Dataset
from .merging import delete_episodes
from .review import EpisodeSummary, draw_sheet, summarize

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
<body><p id="note" role="status">Loading...</p><div id="list"></div><div id="sheet"></div></body></html>"""
_STYLE = """
body { padding: 12px; }
#note { min-height: 24px; color: var(--quiet); }
#list, #sheet { overflow-x: auto; background: var(--panel); border: 1px solid var(--line); padding: 8px; }
#sheet { margin-top: 12px; }
#sheet:empty { display: none; }
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
  const { order: by, show, post, ask } = target.dataset;
  if (ask && !confirm(ask)) return;
  try {
    if (by) order = by;
    if (show) shown = show;
    if (post) await call(post, "POST");
    if (ask) shown = null;
    if (by || show || post) await paint();
  } catch (error) {
    at("note").textContent = error.message;
  }
});
paint().catch((error) => { at("note").textContent = error.message; });
"""
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
}


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
        self.dataset = Path(dataset)
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
        auth, host = self.server.auth, self.headers.get("Host")
        offered = self.headers.get("Authorization", "").removeprefix("Bearer ")
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
                self._send(200, self._act(method, self.path.split("/")[1:]))
            except (CommandError, DatasetError, OSError) as error:
                self._send(409, str(error))
            except (LookupError, ValueError):
                self._send(404, "there is no such page")

    def _send(self, status: int, body: str | bytes, kind: str = "text/plain") -> None:
        data = body.encode() if isinstance(body, str) else body
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def _act(self, method: str, path: list[str]) -> str:
        """Return the HTML at a path, or change the dataset. LookupError or ValueError for an unknown path."""
        dataset = Dataset(self.server.dataset)
        if method == "GET" and path[0] == "episodes":
            return "\n".join(_write_list(dataset, list(_ORDERS)[int(path[1])]))
        number = int(path[1])
        if method == "GET" and path[0] == "sheet":
            return f"{_write_buttons(dataset, number)}{draw_sheet(dataset.episodes[number])}"
        if method == "POST" and int(path[2]) != len(dataset):
            raise CommandError("the dataset has changed since this page showed it: reload the page")
        if method == "POST" and path[0] == "mark":
            mark_episodes(dataset, {number: _MARKS[path[3]]})
        elif method == "POST" and path[0] == "delete":
            delete_episodes(dataset, [number])
        else:
            raise LookupError
        return "done"


def _write_list(dataset: Dataset, order: str) -> Iterator[str]:
    """Yield the table of all episodes as HTML, in an order."""
    found = summarize(dataset)
    about = f"{found.path}: {found.robot_type}, {found.rows} rows at {found.fps} Hz, {found.seconds:.1f} s; "
    about += f"{found.successes} succeeded, {found.failures} failed, {found.unmarked} not marked"
    yield f'<table data-about="{escape(about)}"><tr>'
    for k, name in enumerate(_ORDERS):
        yield f'<th><button data-order="{k}" aria-pressed="{str(name == order).lower()}">{name}</button></th>'
    yield "<th>task</th></tr>"
    for line in sorted(found.episodes, key=_ORDERS[order]):
        mark = {True: "success", False: "failure", None: "-"}[line.success]
        cells = [f"{line.seconds:.1f}", mark, line.trips, line.dropped, f"{line.jerk:.1f}", f"{100 * line.idle:.0f} %"]
        task = line.task + (f" [{line.trouble}]" if line.trouble else "")
        yield f'<tr data-row="{line.number}"><td><button data-show="{line.number}">Show {line.number}</button></td>'
        yield "".join(f"<td>{escape(str(cell))}</td>" for cell in (*cells, task)) + "</tr>"
    yield "</table>"
    yield from (f"<p>cannot be read: {escape(line)}</p>" for line in found.broken)


def _write_buttons(dataset: Dataset, number: int) -> str:
    count, success = len(dataset), dataset.episodes[number].success
    marks = "".join(
        f'<button data-post="/mark/{number}/{count}/{name}" {"data-pressed" * (mark is success)}>{label}</button>'
        for (name, mark), label in zip(_MARKS.items(), ("Success", "Failure", "No mark"), strict=True)
    )
    ask = f"Delete episode {number}? This cannot be undone; later episodes get lower numbers."
    delete = f'<button data-post="/delete/{number}/{count}" data-ask="{ask}">Delete</button>'
    return f'<div class="bar"><h2>Episode {number}</h2>{marks}{delete}</div>'
